# A toolchain that compiles for other systems with zig, a C++ compiler with the libraries of many systems, which pip
# installs (`pip install ziglang`). V3DG_ZIG_TARGET names the system: x86_64-windows-gnu, aarch64-macos or x86_64-macos.

set(V3DG_ZIG_TARGET "" CACHE STRING "The system that zig compiles for")
set(V3DG_ZIG_PYTHON "python3" CACHE STRING "The Python that has the package ziglang")
list(APPEND CMAKE_TRY_COMPILE_PLATFORM_VARIABLES V3DG_ZIG_TARGET V3DG_ZIG_PYTHON)

if(NOT V3DG_ZIG_TARGET MATCHES "^([a-z0-9_]+)-(windows|macos|linux)(-[a-z]+)?$")
    message(FATAL_ERROR "V3DG_ZIG_TARGET: expected a name like x86_64-windows-gnu, got '${V3DG_ZIG_TARGET}'")
endif()
set(CMAKE_SYSTEM_PROCESSOR ${CMAKE_MATCH_1})
set(names_windows Windows)
set(names_macos Darwin)
set(names_linux Linux)
set(CMAKE_SYSTEM_NAME ${names_${CMAKE_MATCH_2}})

set(CMAKE_CXX_COMPILER ${V3DG_ZIG_PYTHON} -m ziglang c++ -target ${V3DG_ZIG_TARGET})
set(V3DG_X86_64_LEVEL x86_64_v)
# zig would trap undefined behaviour where nothing is optimised.
set(CMAKE_CXX_FLAGS_INIT "-fno-sanitize=undefined")
if(CMAKE_SYSTEM_NAME STREQUAL "Darwin")
    string(APPEND CMAKE_CXX_FLAGS_INIT " -include ${CMAKE_CURRENT_LIST_DIR}/zig_macos.h")
endif()
# zig links each system's own libraries; those of this machine are none of them.
set(CMAKE_FIND_ROOT_PATH_MODE_LIBRARY ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_INCLUDE ONLY)

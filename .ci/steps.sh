# The steps of .ci/run, one function each. They run in the root of the checkout and write to build/ci. All steps
# except `environment` and `compile` need the virtual environment that `environment` creates and `install` fills.
# shellcheck shell=bash

readonly test_command="pip install '.[test]' && pytest -n 2"
readonly ci=build/ci

enter() {
    # shellcheck source=/dev/null
    . "$ci/venv/bin/activate"
    unset PYTHONPATH PYTHONHOME
}

# Prints the requirements of some extras of the installed package.
requirements_of() {
    python - "$@" << 'END'
import importlib.metadata
import sys

for requirement in importlib.metadata.requires("v3dg"):
    requirement, _, marker = requirement.partition(";")
    if any(extra in marker for extra in sys.argv[1:]):
        print(requirement)
END
}

# Creates the virtual environment. PYTHON is the name of the interpreter.
environment() {
    rm -rf "$ci/venv"
    "${PYTHON:-python3}" -m venv "$ci/venv"
    enter
    python --version
}

# Runs the first half of the README's test command. CXX is the name of the compiler.
install() {
    [ -d "$ci/venv" ] || environment
    enter
    export CUDAARCHS="${CUDAARCHS:-90}"  # one architecture suffices to show that the CUDA sources compile
    eval "${test_command%% && *}"
    python -c "import torch; print('torch', torch.__version__)"  # without torch, the tests of gradients are skipped
}

# Checks for which instruction set each function is compiled that the linker kept.
isa() {
    enter
    local tag
    tag=$(python -c "import sys; print(f'cp{sys.version_info[0]}{sys.version_info[1]}')")
    if command -v objdump > /dev/null; then
        python .ci/check_isa.py build/"$tag"-*/_core.*.so
    else
        echo "objdump is not installed: skipped"
    fi
}

lint() {
    enter
    requirements_of dev > "$ci/dev.txt"
    pip install --quiet -r "$ci/dev.txt"
    pip install --quiet --no-deps gsplat==1.5.3  # the reference of the tested projections; it needs no dependencies here
    pre-commit run --all-files --show-diff-on-failure
}

# Compiles the module and the C++ example that tests/system/test_cpp_example.py runs. CXX is the name of the compiler.
# V3DG_WERROR=ON treats its warnings as errors; V3DG_CUDA=ON also compiles the CUDA sources.
compile() {
    if [ -d "$ci/venv" ]; then enter; else environment; fi
    pip install --quiet cmake ninja 'pybind11>=2.13'
    cmake -S . -B "$ci/cpp" -G Ninja -DCMAKE_BUILD_TYPE=Release -DV3DG_CUDA="${V3DG_CUDA:-OFF}" \
        -DV3DG_WERROR="${V3DG_WERROR:-OFF}" -Dpybind11_DIR="$(python -m pybind11 --cmakedir)" > /dev/null
    cmake --build "$ci/cpp" --target all draw_scene > "$ci/cpp.log" || { cat "$ci/cpp.log" >&2; return 1; }
}

docs() {
    enter
    requirements_of docs > "$ci/docs.txt"
    pip install --quiet -r "$ci/docs.txt"
    NO_MKDOCS_2_WARNING=1 mkdocs build --strict --quiet
}

# Runs the second half of the README's test command, and records the duration of each test.
run_tests() {
    enter
    local status=0
    PYTEST_ADDOPTS="--junit-xml=$PWD/$ci/$1.xml ${*:2}" eval "${test_command#* && }" || status=$?
    [ ! -f "$ci/$1.xml" ] || python .ci/durations.py "$ci/$1.xml" | tee "$ci/$1.md"
    return "$status"
}

tests() { run_tests tests; }

# Runs all tests except those that are marked slow.
fast_tests() { run_tests fast "-m 'not slow'"; }

evaluation() {
    enter
    python -m benchmarks evaluate -o "$ci/evaluation" > "$ci/evaluation.md"
}

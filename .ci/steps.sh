# The steps of .ci/run, a function each. They work in the root of the checkout and keep what they make in build/ci;
# all but `environment` and `compile` need the environment that `environment` makes and `install` fills.
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

# PYTHON names the interpreter.
environment() {
    rm -rf "$ci/venv"
    "${PYTHON:-python3}" -m venv "$ci/venv"
    enter
    python --version
}

# The first half of the README's command; CXX names the compiler.
install() {
    [ -d "$ci/venv" ] || environment
    enter
    export CUDAARCHS="${CUDAARCHS:-90}"  # one architecture shows that the CUDA half compiles
    eval "${test_command%% && *}"
    python -c "import torch; print('torch', torch.__version__)"  # without it the gradient tests would be skipped
}

# What the linker kept for which instruction set.
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
    pip install --quiet --no-deps gsplat==1.5.3  # the witness of the golden projections; its dependencies are not needed
    pre-commit run --all-files --show-diff-on-failure
}

# Without CUDA, with the C library and the C++ example that tests/system/test_cpp_example.py runs. CXX names the
# compiler, V3DG_WERROR=ON makes its warnings errors, V3DG_CUDA=ON compiles the CUDA half, too.
compile() {
    if [ -d "$ci/venv" ]; then enter; else environment; fi
    pip install --quiet cmake ninja 'pybind11>=2.13' nlohmann-json
    local json
    json=$(python -c "import nlohmann_json; print(nlohmann_json.__path__[0])")/include
    cmake -S . -B "$ci/cpp" -G Ninja -DCMAKE_BUILD_TYPE=Release -DV3DG_CUDA="${V3DG_CUDA:-OFF}" \
        -DV3DG_WERROR="${V3DG_WERROR:-OFF}" -Dpybind11_DIR="$(python -m pybind11 --cmakedir)" \
        -DV3DG_C_LIBRARY=ON -DV3DG_JSON_INCLUDE_DIR="$json" > /dev/null
    cmake --build "$ci/cpp" --target all draw_scene > "$ci/cpp.log" || { cat "$ci/cpp.log" >&2; return 1; }
}

docs() {
    enter
    requirements_of docs > "$ci/docs.txt"
    pip install --quiet -r "$ci/docs.txt"
    NO_MKDOCS_2_WARNING=1 mkdocs build --strict --quiet
}

# Runs the second half of the README's command and keeps how long each test took.
run_tests() {
    enter
    local status=0
    PYTEST_ADDOPTS="--junit-xml=$PWD/$ci/$1.xml ${*:2}" eval "${test_command#* && }" || status=$?
    [ ! -f "$ci/$1.xml" ] || python .ci/durations.py "$ci/$1.xml" | tee "$ci/$1.md"
    return "$status"
}

tests() { run_tests tests; }

# All but the slow kinds of tests.
fast_tests() { run_tests fast "-m 'not slow'"; }

evaluation() {
    enter
    python -m benchmarks evaluate -o "$ci/evaluation" > "$ci/evaluation.md"
}

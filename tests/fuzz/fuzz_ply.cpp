// Coverage-guided fuzzer of the .ply reader, for libFuzzer (tests/fuzz/run builds and starts it).
#include <cstdint>
#include <cstdlib>
#include <string>
#include <system_error>
#include <vector>

#include <sys/mman.h>
#include <unistd.h>

#include "io/ply.h"

namespace {

void require(bool condition) {
    if (!condition) std::abort();
}

bool is_printable(const std::string& text) {
    for (const char c : text)
        if (c < ' ' || c > '~') return false;
    return !text.empty();
}

void read(const char* path, size_t file_bytes) {
    const v3dg::PlyFile ply = v3dg::open_ply(path);
    const size_t n = ply.num_gaussians();
    const size_t floats = n * (11 + 3 * ply.num_sh);
    // A number takes at least one byte in the file, and four in memory.
    require(n == 0 || (floats / n == 11 + 3 * ply.num_sh && floats <= file_bytes));
    std::vector<float> memory(floats);
    float* next = memory.data();
    const auto span = [&](size_t size) {
        const v3dg::Span<float> result = {next, size};
        next += size;
        return result;
    };
    const v3dg::PlyGaussians<float> out = {span(3 * n), span(4 * n), span(3 * n), span(n),
                                           span(3 * n * ply.num_sh)};
    v3dg::read_ply(ply, 0, ply.begin(), out);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    // A file in memory, emptied and filled again each time.
    static const int file = memfd_create("fuzz_ply", 0);
    static const std::string path = "/proc/self/fd/" + std::to_string(file);
    require(file >= 0 && ftruncate(file, 0) == 0);
    require(pwrite(file, data, size, 0) == static_cast<ssize_t>(size));
    try {
        read(path.c_str(), size);
    } catch (const v3dg::PlyError& error) {
        require(is_printable(error.what()));
    }
    return 0;
}

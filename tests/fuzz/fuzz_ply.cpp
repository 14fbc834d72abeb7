// Coverage-guided fuzzer of the .ply reader, for libFuzzer (tests/fuzz/run.py builds and starts
// it).
#include <cstdint>
#include <cstdlib>
#include <cstring>
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

// Reads gaussians first .. last: means, quaternions and so on.
std::vector<float> read(const v3dg::PlyFile& ply, size_t first, size_t last,
                        v3dg::PlyPlace& place) {
    const size_t n = last - first;
    std::vector<float> memory(n * (11 + 3 * ply.layout.num_sh));
    float* next = memory.data();
    const auto span = [&](size_t size) {
        const v3dg::Span<float> result = {next, size};
        next += size;
        return result;
    };
    const v3dg::PlyGaussians<float> out = {span(3 * n), span(4 * n), span(3 * n), span(n),
                                           span(3 * n * ply.layout.num_sh)};
    place = v3dg::read_ply(ply, first, place, out);
    return memory;
}

void read(const char* path, size_t file_bytes) {
    const v3dg::PlyFile ply = v3dg::open_ply(path);
    const size_t n = ply.num_gaussians();
    const size_t row_floats = 11 + 3 * ply.layout.num_sh;
    const size_t floats = n * row_floats;
    // A number occupies at least one byte in the file, and four in memory; a flat gaussian has one
    // number less in the file.
    require(n == 0 || (floats / n == row_floats && floats - n <= file_bytes));
    v3dg::PlyPlace end = ply.begin(), start = ply.begin(), middle = ply.begin();
    read(ply, 0, n, end);
    // The second half must be the same whether the first was read before it or skipped.
    read(ply, 0, n / 2, middle);
    const std::vector<float> after = read(ply, n / 2, n, middle),
                             skipped = read(ply, n / 2, n, start);
    require(after.size() == skipped.size() && middle.offset == end.offset &&
            start.offset == end.offset);
    require(after.empty() ||
            std::memcmp(after.data(), skipped.data(), after.size() * sizeof(float)) == 0);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    // The file is in memory, and is emptied and filled again each time.
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

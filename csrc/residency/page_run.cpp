#include "residency/page_run.h"

#include <algorithm>
#include <vector>

#include "base/buffer.h"
#include "base/parallel_for.h"
#include "io/blake2b.h"
#include "quantize/quantize.h"

namespace v3dg {

static std::string name_of(const PageRun& run, size_t page) {
    const Span<const int64_t> clusters = run.clusters(page);
    return "page " + std::to_string(run.first_page + page) + " (gaussians " + std::to_string(clusters[0]) +
           " to " + std::to_string(clusters[clusters.size - 1] - 1) + ")";
}

static void read_bytes(const PosixFile& file, const PageRun& run, size_t page, unsigned char* bytes) {
    read_verified(file, run.places[page], run.num_bytes(page), run.hashes.data + kPageHashBytes * page,
                  name_of(run, page), bytes);
}

void read_pages(const PosixFile& file, const PageRun& run, PageCodec codec, const GaussianRows<float>& out) {
    parallel_for(run.size(), 1, [&](size_t page) {
        Buffer<uint32_t> words(run.num_bytes(page) / sizeof(uint32_t) + 1);
        auto* const bytes = reinterpret_cast<unsigned char*>(words.data());
        read_bytes(file, run, page, bytes);
        std::vector<int64_t> clusters;
        for (const int64_t row : run.clusters(page)) clusters.push_back(row - run.offset[0]);
        const auto first = static_cast<size_t>(clusters.front());
        const auto count = static_cast<size_t>(clusters.back()) - first;
        if (codec == PageCodec::quantized) {
            try {
                cpu::decode_page({{clusters.data(), clusters.size()}, words.data(), out.sh_degree}, out);
            } catch (const std::invalid_argument& error) {
                throw PageError(name_of(run, page) + ": " + error.what() + "; " + kDamaged, true);
            }
            return;
        }
        const GaussianRows<const float> rows = rows_of_page(bytes, count, out.sh_degree);
        const auto copy = [&](const float* from, float* to, size_t width) {
            std::copy_n(from, count * width, to + first * width);
        };
        copy(rows.means, out.means, 3);
        copy(rows.quats, out.quats, 4);
        copy(rows.scales, out.scales, 3);
        copy(rows.opacities, out.opacities, 1);
        copy(rows.sh, out.sh, out.num_sh());
    });
}

void read_codes(const PosixFile& file, const PageRun& run, Span<int32_t> words) {
    auto* const bytes = reinterpret_cast<unsigned char*>(words.data);
    parallel_for(run.size(), 1, [&](size_t page) {
        read_bytes(file, run, page, bytes + (run.places[page] - run.places[0]));
    });
}

}  // namespace v3dg

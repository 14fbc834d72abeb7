// Reads, verifies and decodes adjacent pages of a file; or encodes, hashes and writes
// them. A thread processes several pages at once, because they are hashed in parallel
// SIMD lanes.

#include "residency/page_run.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "base/buffer.h"
#include "base/parallel_for.h"
#include "base/threads.h"
#include "io/blake2b.h"
#include "quantize/quantize.h"

namespace v3dg {

// Number of pages that a thread reads at once, which equals the number of pages that
// are hashed in parallel.
constexpr size_t kFew = 8;

static std::string name_of(const PageRun& run, size_t page) {
    const Span<const int64_t> clusters = run.clusters(page);
    return "page " + std::to_string(run.first_page + page) + " (gaussians " +
           std::to_string(clusters[0]) + " to " + std::to_string(clusters[clusters.size - 1] - 1) +
           ")";
}

// Reads `count` pages into contiguous memory, and calls use(page, bytes) for each.
// Throws PageError for the first page that cannot be read.
template <class Use>
static void read_few(const File& file, const PageRun& run, size_t first, size_t count,
                     unsigned char* bytes, const Use& use) {
    PageReading pages[kFew];
    for (size_t k = 0; k < count; ++k) {
        pages[k].page = first + k;
        pages[k].bytes = bytes + (run.places[first + k] - run.places[first]);
    }
    read_verified(file, run.places, run.hashes.data, {pages, count},
                  [&](size_t page) { return name_of(run, page); });
    for (size_t k = 0; k < count; ++k) {
        if (pages[k].error) throw PageError(*pages[k].error);
        use(pages[k].page, pages[k].bytes);
    }
}

// Calls read(first page, number of pages) for parts of the run, using all threads.
template <class Read>
static void for_few_pages(const PageRun& run, const Read& read) {
    const size_t share = run.size() / static_cast<size_t>(most_threads());
    const size_t few = std::clamp<size_t>(share, 1, kFew);
    parallel_for((run.size() + few - 1) / few, 1,
                 [&](size_t k) { read(k * few, std::min(few, run.size() - k * few)); });
}

static void decode(const PageRun& run, size_t page, PageCodec codec, const unsigned char* bytes,
                   const GaussianRows<float>& out) {
    std::vector<int64_t> clusters;
    for (const int64_t row : run.clusters(page)) clusters.push_back(row - run.offset[0]);
    const auto first = static_cast<size_t>(clusters.front());
    const auto count = static_cast<size_t>(clusters.back()) - first;
    if (codec == PageCodec::quantized) {
        const auto* words = reinterpret_cast<const uint32_t*>(bytes);
        try {
            cpu::decode_page({{clusters.data(), clusters.size()}, words, out.sh_degree}, out);
        } catch (const std::invalid_argument& error) {
            throw PageError(name_of(run, page) + ": " + error.what() + "; " + kDamaged, true);
        }
        return;
    }
    const GaussianRows<const float> rows = rows_of_page(bytes, count, out.sh_degree);
    const auto copy = [&](const float* source, float* destination, size_t width) {
        std::copy_n(source, count * width, destination + first * width);
    };
    copy(rows.means, out.means, 3);
    copy(rows.quats, out.quats, 4);
    copy(rows.scales, out.scales, 3);
    copy(rows.opacities, out.opacities, 1);
    copy(rows.sh, out.sh, out.num_sh());
}

void read_pages(const File& file, const PageRun& run, PageCodec codec,
                const GaussianRows<float>& out) {
    for_few_pages(run, [&](size_t first, size_t count) {
        Buffer<uint32_t> words((run.places[first + count] - run.places[first]) / sizeof(uint32_t) +
                               1);
        read_few(
            file, run, first, count, reinterpret_cast<unsigned char*>(words.data()),
            [&](size_t page, const unsigned char* bytes) { decode(run, page, codec, bytes, out); });
    });
}

// Encodes one page. `clusters` has the first row of each of its clusters, then the end.
static void encode(Span<const int64_t> clusters, PageCodec codec,
                   const GaussianRows<const float>& rows, unsigned char* bytes) {
    if (codec == PageCodec::quantized) {
        cpu::encode_page(rows, {clusters, reinterpret_cast<uint32_t*>(bytes), rows.sh_degree});
        return;
    }
    const auto first = static_cast<size_t>(clusters[0]);
    const auto count = static_cast<size_t>(clusters[clusters.size - 1]) - first;
    const auto copy = [&](const float* source, size_t width) {
        const size_t size = count * width * sizeof(float);
        std::memcpy(bytes, source + first * width, size);
        bytes += size;
    };
    copy(rows.means, 3);
    copy(rows.quats, 4);
    copy(rows.scales, 3);
    copy(rows.opacities, 1);
    copy(rows.sh, rows.num_sh());
}

void write_pages(const File& file, const PageRun& run, PageCodec codec,
                 const GaussianRows<const float>& rows, uint8_t* hashes) {
    std::vector<int64_t> row_of_cluster;
    for (const int64_t row : run.offset) row_of_cluster.push_back(row - run.offset[0]);
    for_few_pages(run, [&](size_t first, size_t count) {
        const auto size = static_cast<size_t>(run.places[first + count] - run.places[first]);
        Buffer<uint32_t> words(size / sizeof(uint32_t) + 1);
        auto* const bytes = reinterpret_cast<unsigned char*>(words.data());
        std::memset(bytes, 0, size);
        Span<const uint8_t> pages[kFew];
        for (size_t k = 0; k < count; ++k) {
            const size_t page = first + k;
            unsigned char* const of_page = bytes + (run.places[page] - run.places[first]);
            encode({row_of_cluster.data() + run.first_cluster[page], run.clusters(page).size},
                   codec, rows, of_page);
            pages[k] = {of_page, run.num_bytes(page)};
        }
        PageHash digests[kFew];
        blake2b({pages, count}, digests);
        for (size_t k = 0; k < count; ++k)
            std::copy(digests[k].begin(), digests[k].end(), hashes + kPageHashBytes * (first + k));
        file.write_at(static_cast<size_t>(run.places[first]), reinterpret_cast<const char*>(bytes),
                      size);
    });
}

void read_codes(const File& file, const PageRun& run, Span<int32_t> words) {
    auto* const bytes = reinterpret_cast<unsigned char*>(words.data);
    for_few_pages(run, [&](size_t first, size_t count) {
        read_few(file, run, first, count, bytes + (run.places[first] - run.places[0]),
                 [](size_t, const unsigned char*) {});
    });
}

}  // namespace v3dg

// Decodes pages and clusters on all threads, and writes pages to slots. encode_cpu.cpp
// encodes pages.

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/parallel_for.h"
#include "quantize/coded_ranges.h"
#include "quantize/quantize.h"

namespace v3dg {

namespace {

constexpr size_t kClustersAtOnce = 16;

CodedRanges ranges_at(const uint32_t* words, int sh_degree) {
    CodedRanges out;
    std::memcpy(&out.code, words, sizeof out.code);
    std::memcpy(out.sh_steps, words + sizeof out.code / 4, 6 * static_cast<size_t>(sh_degree));
    return out;
}

// Returns the ranges of a cluster. Throws std::invalid_argument if they are invalid;
// the message names the cluster.
ClusterRanges valid_ranges(const uint32_t* words, int sh_degree, size_t cluster,
                           const char* whose) {
    const CodedRanges coded = ranges_at(words, sh_degree);
    if (!are_valid(coded.code, coded.sh_steps, sh_degree))
        throw std::invalid_argument("cluster " + std::to_string(cluster) + whose +
                                    ": expected finite ranges, got infinite or NaN ones");
    return decoded(coded, sh_degree);
}

}  // namespace

void cpu::decode_page(const PageCodes<const uint32_t>& page, const GaussianRows<float>& out) {
    parallel_for(page.num_clusters(), kClustersAtOnce, [&](size_t c) {
        const ClusterRanges ranges =
            valid_ranges(page.ranges(c), page.sh_degree, c, " of the page");
        for (auto row = static_cast<size_t>(page.offset[c]);
             row < static_cast<size_t>(page.offset[c + 1]); ++row)
            decode_row(page.record(row), page.sh(row), ranges, out, row);
    });
}

CodedPages::CodedPages(const uint32_t* words, Span<const int64_t> first_cluster,
                       Span<const int64_t> offset, int sh_degree)
    : ranges_(size_t(range_bytes(sh_degree)) * (offset.size - 1)),
      first_cluster_(first_cluster),
      codes_{.records = words,
             .sh = words,
             .ranges = ranges_.data(),
             .offset = offset,
             .sh_degree = sh_degree,
             .range_size = range_bytes(sh_degree),
             .sh_stride = static_cast<uint32_t>(sh_degree)} {
    // Offset of each page, in words.
    std::vector<uint64_t> place(first_cluster.size, 0);
    const auto page_at = [&](size_t p) {
        const auto first = static_cast<size_t>(first_cluster[p]),
                   last = static_cast<size_t>(first_cluster[p + 1]);
        return PageCodes<const uint32_t>{
            {offset.data + first, last - first + 1}, words + place[p], sh_degree};
    };
    for (size_t p = 0; p + 1 < place.size(); ++p) {
        const PageCodes<const uint32_t> page = page_at(p);
        place[p + 1] =
            place[p] +
            page_bytes(page.end_row() - page.first_row(), page.num_clusters(), sh_degree) / 4;
    }
    parallel_for(place.size() - 1, kClustersAtOnce, [&](size_t p) {
        const PageCodes<const uint32_t> page = page_at(p);
        const size_t first_row = page.first_row();
        for (size_t k = 0; k < page.num_clusters(); ++k) {
            const auto c = static_cast<size_t>(first_cluster[p]) + k;
            ClusterRanges ranges = valid_ranges(page.ranges(k), sh_degree, c, "");
            ranges.record_base =
                static_cast<uint32_t>((page.record(first_row) - words) / kRecordWords - first_row);
            ranges.sh_base =
                static_cast<uint32_t>((page.sh(first_row) - words) / 2 - sh_degree * first_row);
            std::memcpy(ranges_.data() + size_t(range_bytes(sh_degree)) * c, &ranges,
                        range_bytes(sh_degree));
        }
    });
}

void cpu::write_slot(const SlotPage& from, const CodeSlots& to) {
    const PageCodes<const uint32_t>& page = from.page;
    const size_t first = page.first_row(), count = page.end_row() - first;
    const auto width = static_cast<size_t>(num_sh_words(page.sh_degree));
    std::copy_n(page.record(first), kRecordWords * count, to.records + kRecordWords * from.row);
    for (size_t i = 0; i < count && width > 0; ++i)
        std::copy_n(page.sh(first + i), width, to.sh + 2 * to.sh_stride * (from.row + i));
    for (size_t k = 0; k < from.num_clusters; ++k) write_cluster(from, k, to);
}

void cpu::decode(const DecodeInput& in, const GaussianRows<float>& out) {
    parallel_for(in.cluster.size, kClustersAtOnce, [&](size_t s) {
        const ClusterRanges& ranges = in.codes.ranges_of(in.cluster[s]);
        const auto first = static_cast<uint32_t>(in.codes.offset[in.cluster[s]]);
        for (int64_t row = in.offset[s]; row < in.offset[s + 1]; ++row) {
            const uint32_t from = first + static_cast<uint32_t>(row - in.offset[s]);
            decode_row(in.codes.record_of(ranges, from), in.codes.sh_of(ranges, from), ranges, out,
                       row);
        }
    });
}

}  // namespace v3dg

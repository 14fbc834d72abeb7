#pragma once

// Gaussians as codes of few bits: in pages of bundles, in pages on the host, and in
// slots of a pool. This is the codec "quantized" of v3dg/bundle/codec.py.
// docs/extending.md describes how to add a codec.

#include <cstring>

#include "base/buffer.h"
#include "base/span.h"
#include "base/stream.h"
#include "quantize/quantize_math.h"

namespace v3dg {

// A coded page of K clusters. It has one record per gaussian, then the codes of the SH
// coefficients above degree 0, then the ranges of the clusters. T is const if the page
// is only read.
template <class T>
struct PageCodes {
    Span<const int64_t> offset;  // [K + 1] first row of each cluster, ascending
    T* words;                    // page_bytes() bytes
    int sh_degree;

    V3DG_HD size_t num_clusters() const { return offset.size - 1; }
    V3DG_HD size_t first_row() const { return static_cast<size_t>(offset[0]); }
    V3DG_HD size_t end_row() const { return static_cast<size_t>(offset[offset.size - 1]); }
    V3DG_HD T* record(size_t row) const { return words + kRecordWords * (row - first_row()); }
    V3DG_HD T* sh(size_t row) const {
        return record(end_row()) + num_sh_words(sh_degree) * (row - first_row());
    }
    V3DG_HD T* ranges(size_t cluster) const {
        return sh(end_row()) + cluster_code_bytes(sh_degree) / 4 * cluster;
    }
};

// Decodes one gaussian to a row.
V3DG_HD inline void decode_row(const uint32_t* record, const uint32_t* sh_words,
                               const ClusterRanges& ranges, const GaussianRows<float>& out,
                               size_t row) {
    Gaussian3d<float> g;
    float* sh = out.sh + out.num_sh() * row;
    decode(record, ranges, g, sh);
    decode_sh(sh_words, ranges.sh_step, out.sh_degree, sh + 3);
    for (int k = 0; k < 3; ++k) {
        out.means[3 * row + k] = g.mean[k];
        out.scales[3 * row + k] = g.scale[k];
    }
    for (int k = 0; k < 4; ++k) out.quats[4 * row + k] = g.quat[k];
    out.opacities[row] = g.opacity;
}

// The coded pages of a bundle on the host, in the layout of its file. It points to the
// codes and offsets, and owns the ranges.
class CodedPages {
  public:
    // `words` has all P pages; first_cluster is [P + 1], and offset is [C + 1]. Throws
    // std::invalid_argument if ranges are invalid; the message names the cluster.
    CodedPages(const uint32_t* words, Span<const int64_t> first_cluster, Span<const int64_t> offset,
               int sh_degree);
    const Codes& codes() const { return codes_; }
    Span<const int64_t> first_cluster() const { return first_cluster_; }
    size_t bytes() const { return ranges_.capacity(); }

  private:
    Buffer<unsigned char> ranges_;
    Span<const int64_t> first_cluster_;
    Codes codes_;
};

// The memory of a pool that keeps codes. Frames read it like the codes of a single
// bundle. It is divided into slots of equal size, each for one page. The rows of all
// slots are contiguous, and so are their clusters. The ranges of a cluster contain the
// location of its codes, so other code need not look up which slot a page is in.
struct CodeSlots {
    uint32_t *records, *sh;
    unsigned char* ranges;
    int64_t* offset;  // as in Codes::offset; stays ascending when a slot is written
    uint32_t range_size, sh_stride;
    size_t num_clusters;

    // Returns the codes for drawing a bundle of this SH degree.
    Codes codes(int sh_degree) const {
        return {.records = records,
                .sh = sh,
                .ranges = ranges,
                .offset = {offset, num_clusters + 1},
                .sh_degree = sh_degree,
                .range_size = range_size,
                .sh_stride = sh_stride};
    }
};

// Number of bytes in a slot per row, and per cluster.
constexpr size_t slot_row_bytes(int sh_degree) {
    return 4 * (kRecordWords + num_sh_words(sh_degree));
}
constexpr size_t slot_cluster_bytes(int sh_degree) {
    return range_bytes(sh_degree) + sizeof(int64_t);
}

// A page, and the slot that it is written to.
struct SlotPage {
    PageCodes<const uint32_t> page;
    size_t row, cluster;  // first row and cluster of the slot
    // Number of clusters of the page. All other clusters of the slot become empty.
    size_t num_clusters;
};

// Writes the ranges and the offset of the k-th cluster of a slot.
V3DG_HD inline void write_cluster(const SlotPage& from, size_t k, const CodeSlots& to) {
    const PageCodes<const uint32_t>& page = from.page;
    const size_t begin =
        static_cast<size_t>(page.offset[k < page.num_clusters() ? k : page.num_clusters()]);
    to.offset[from.cluster + k] = static_cast<int64_t>(from.row + begin - page.first_row());
    if (k >= page.num_clusters()) return;
    ClusterCode code;
    uint16_t sh_steps[9] = {};
    std::memcpy(&code, page.ranges(k), sizeof code);
    std::memcpy(sh_steps, page.ranges(k) + sizeof code / 4,
                6 * static_cast<size_t>(page.sh_degree));
    const ClusterRanges ranges = ranges_of(code, sh_steps, page.sh_degree);
    std::memcpy(to.ranges + to.range_size * (from.cluster + k), &ranges,
                range_bytes(page.sh_degree));
}

// Clusters to decode, in any order, and the rows to write their gaussians to.
struct DecodeInput {
    Codes codes;
    Span<const int32_t> cluster;  // [S]
    // [S + 1] first row of each cluster in the result, ascending from 0
    Span<const int64_t> offset;
};

namespace cpu {
// Encodes gaussians, rounded to the steps of their cluster's ranges. Gaussians that
// were decoded from a page give the same page again. A scale of 0 becomes 2^-14 of the
// gaussian's largest scale. Scales are clamped to [2^-64, 2^64], means to 2^126,
// colours to 32,768, other SH coefficients to 1,024, and opacities to [0, 1]. Throws
// std::invalid_argument if a value is not finite.
void encode_page(const GaussianRows<const float>& in, const PageCodes<uint32_t>& page);

// Decodes the gaussians of a page. Throws std::invalid_argument if ranges are invalid;
// the message names the cluster.
void decode_page(const PageCodes<const uint32_t>& page, const GaussianRows<float>& out);

// Decodes the gaussians of clusters.
void decode(const DecodeInput& in, const GaussianRows<float>& out);

// Writes a page to its slot. Precondition: the ranges of the page are valid.
void write_slot(const SlotPage& from, const CodeSlots& to);
}  // namespace cpu

// Like cpu::decode(), with the same bits. The codes and `out` are on the device, and
// all other arrays in host memory. The work is enqueued on the stream. Throws
// std::runtime_error if CUDA reports an error.
namespace cuda {
void decode(const DecodeInput& in, const GaussianRows<float>& out, Stream stream);

// Like cpu::write_slot(), for several pages. The device must be able to read `pages`.
// The memory of the pages and the slots is on the device.
void write_slots(const SlotPage* pages, size_t num_pages, const CodeSlots& to, Stream stream);
}  // namespace cuda

}  // namespace v3dg

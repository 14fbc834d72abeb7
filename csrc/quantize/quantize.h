#pragma once

#include "base/buffer.h"
#include "base/span.h"
#include "base/stream.h"
#include "quantize/quantize_math.h"

namespace v3dg {

// A page of K clusters: the codes of its gaussians, a row of words each; those of their higher coefficients;
// the ranges of its clusters. T is const where it is only read.
template <class T>
struct PageCodes {
    Span<const int64_t> offset;  // [K + 1] rows of gaussians of each cluster, ascending
    T* words;                    // page_bytes()
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

// Writes one gaussian to a row.
V3DG_HD inline void decode_row(const uint32_t* record, const uint32_t* sh_words, const ClusterRanges& ranges,
                               const GaussianRows<float>& out, size_t row) {
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

// Pages of a bundle on the host, as its file has them. Borrows words and offsets, owns the ranges.
class CodedPages {
  public:
    // words: all pages, P of them; first_cluster: [P + 1]; offset: [C + 1]. Throws std::invalid_argument,
    // naming the cluster, where ranges are not are_valid().
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

// Clusters, in any order, and where their gaussians are to be.
struct DecodeInput {
    Codes codes;
    Span<const int32_t> cluster;  // [S]
    Span<const int64_t> offset;   // [S + 1] rows of the result, ascending from 0
};

namespace cpu {
// Codes gaussians to the nearest step of the ranges of their clusters; what was decoded from a page gives the
// same page again. A scale of 0 becomes 2^-14 of the largest of its gaussian; scales are kept from 2^-64 to
// 2^64, means within 2^126, colours within 32,768, higher coefficients within 1,024 and opacities from 0
// to 1. Throws std::invalid_argument where a value is not finite.
void encode_page(const GaussianRows<const float>& in, const PageCodes<uint32_t>& page);

// The gaussians of a page. Throws std::invalid_argument, naming the cluster, where ranges are not
// are_valid().
void decode_page(const PageCodes<const uint32_t>& page, const GaussianRows<float>& out);

// The gaussians of clusters.
void decode(const DecodeInput& in, const GaussianRows<float>& out);
}  // namespace cpu

// The same bits. The codes and `out` are on the device, all else on the host. Work is queued on the stream.
// Throws std::runtime_error when CUDA reports an error.
namespace cuda { void decode(const DecodeInput& in, const GaussianRows<float>& out, Stream stream); }

}  // namespace v3dg

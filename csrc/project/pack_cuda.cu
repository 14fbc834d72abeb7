// Packs gaussians into the planes that frames read. The input is the rows of an asset,
// or the pages of a pool, as rows or as codes.

#include "base/launch.cuh"
#include "math/gaussian.h"
#include "project/project_cuda.h"
#include "quantize/quantize_math.h"

namespace v3dg {
namespace cuda {

namespace {

// Packs one gaussian into row `row` of four planes with `num_rows` rows each.
__device__ void pack_row(const Gaussian3d<float>& gaussian, const float* sh, float4* planes,
                         size_t num_rows, size_t row) {
    const PackedGaussian p = pack_gaussian(gaussian);
    planes[row] = {p.mean[0], p.mean[1], p.mean[2], p.reach};
    planes[num_rows + row] = {p.f[0], p.f[1], p.f[2], p.f[3]};
    planes[2 * num_rows + row] = {p.f[4], p.f[5], p.f[6], p.f[7]};
    float color[3];
    color_of_sh(0, gaussian.mean, sh, color);
    planes[3 * num_rows + row] = {p.log2_opacity, color[0], color[1], color[2]};
}

__global__ void pack_kernel(GaussianRows<const float> rows, float4* planes) {
    const size_t g = blockIdx.x * size_t(blockDim.x) + threadIdx.x;
    if (g < rows.size)
        pack_row(gaussian_in_row(rows, g), rows.sh + g * rows.num_sh(), planes, rows.size, g);
}

// Decodes a row of a coded page. `sh` must have room for all SH coefficients.
__device__ Gaussian3d<float> decoded(const PageCodes<const uint32_t>& codes, size_t row,
                                     float* sh) {
    // Find the last cluster that begins at or before the row.
    size_t cluster = codes.num_clusters() - 1;
    while (static_cast<size_t>(codes.offset[cluster]) > row) --cluster;
    const uint32_t* words = codes.ranges(cluster);
    const auto& code = *reinterpret_cast<const ClusterCode*>(words);
    const auto* steps = reinterpret_cast<const uint16_t*>(words + sizeof(ClusterCode) / 4);
    const ClusterRanges ranges = ranges_of(code, steps, codes.sh_degree);
    Gaussian3d<float> gaussian;
    decode(codes.record(row), ranges, gaussian, sh);
    decode_sh(codes.sh(row), ranges.sh_step, codes.sh_degree, sh + 3);
    return gaussian;
}

// Launched with one block per page. `sh` receives the coefficients of degree 1 and
// above; `planes` receive the colour of degree 0.
__global__ void pack_pages_kernel(const PageRows* pages, float4* planes, size_t num_rows, float* sh,
                                  int sh_stride) {
    const PageRows page = pages[blockIdx.x];
    const unsigned num_sh = page.rows.num_sh();
    for (size_t g = threadIdx.x; g < page.rows.size; g += blockDim.x) {
        const size_t row = page.first_row + g;
        if (page.codes.words == nullptr) {
            pack_row(gaussian_in_row(page.rows, g), page.rows.sh + g * num_sh, planes, num_rows,
                     row);
            continue;
        }
        float own_sh[3 * kMaxShBases];
        const Gaussian3d<float> gaussian = decoded(page.codes, page.codes.first_row() + g, own_sh);
        pack_row(gaussian, own_sh, planes, num_rows, row);
        for (unsigned k = 0; k < num_sh && page.rows.sh_degree > 0; ++k)
            sh[row * sh_stride + k] = own_sh[k];
    }
    if (page.rows.sh_degree == 0 || page.codes.words != nullptr) return;
    for (unsigned i = threadIdx.x; i < num_sh * page.rows.size; i += blockDim.x)
        sh[(page.first_row + i / num_sh) * sh_stride + i % num_sh] = page.rows.sh[i];
}

}  // namespace

PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream) {
    const size_t count = rows.size;
    constexpr unsigned kThreads = 256;
    launch("pack_kernel", pack_kernel, blocks_for(count, kThreads), kThreads, 0, stream, rows,
           reinterpret_cast<float4*>(planes));
    return {.plane = {planes, planes + 4 * count, planes + 8 * count, planes + 12 * count},
            .sh = rows.sh,
            .sh_degree = rows.sh_degree,
            .sh_stride = rows.num_sh(),
            .palette = {}};
}

void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream) {
    constexpr unsigned kThreads = 128;
    launch("pack_pages_kernel", pack_pages_kernel, static_cast<unsigned>(num_pages), kThreads, 0,
           stream, pages, reinterpret_cast<float4*>(planes), num_rows, sh, sh_stride);
}

}  // namespace cuda
}  // namespace v3dg

// The backward pass of blending on CUDA. A block processes a tile, a warp 8 x 4 pixels,
// and a lane one pixel. The list of the tile is processed front to back, as in the
// forward pass.
//
// The gradient of a gaussian is a sum over pixels. A warp computes the sums of kHeld
// gaussians at once. First, each lane stores the contribution of its pixel to each of
// these gaussians. Then, each lane adds up a row of 8 pixels for one gaussian. This
// takes a fifth of the time of one warp reduction per gaussian.

#include <cmath>

#include "base/scan.cuh"
#include "frame/record.cuh"
#include "rasterize/rasterize.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kWarps = kFrameTileWidth * kFrameTileHeight / 32;
constexpr int kThreads = 32 * kWarps;
constexpr int kWarpWidth = 8, kWarpHeight = 4;  // size in px of the area that a warp
                                                // processes
constexpr int kWarpColumns = kFrameTileWidth / kWarpWidth;
constexpr int kBatch = 192;  // number of entries that are processed together
constexpr int kPairs = 768;  // maximum number of (entry, warp) pairs in a batch
constexpr int kHeld = 8;     // number of gaussians whose sums a warp computes together
constexpr int kGradientValues = sizeof(RecordGradient<float>) / sizeof(float);
constexpr int kSizeValues = sizeof(CenterSize<float>) / sizeof(float);
// The number of sums per gaussian.
template <bool kWithSize>
constexpr int kValuesOf = kGradientValues + (kWithSize ? kSizeValues : 0);
static_assert(kHeld * kWarpHeight == 32 && kWarpHeight == 4, "a lane sums one row of one gaussian");
constexpr int kTogether = 2;  // number of gaussians that are blended between two
                              // branches
static_assert(kPairs >= kWarps, "a batch must have room for all pairs of an entry");
static_assert(kBatch <= 255 && kBatch % 32 == 0 && kHeld % kTogether == 0, "");

// One pixel's contribution to the gradient of a gaussian.
struct Share {
    float d_exponent, weight;
};
constexpr int kShareStride = 33;  // elements per gaussian; odd, to avoid bank conflicts
constexpr int kRowsStride = 40;   // row sums per value, padded to avoid bank conflicts
static_assert(kRowsStride * kValuesOf<true> * sizeof(float) <= kHeld * kShareStride * sizeof(Share),
              "");

// The data of a batch that must be kept until its pairs have been summed.
struct Batch {
    uint32_t slot[kBatch];
    uint32_t first_pair[kBatch];
    // Which warps blended each entry. Bit k belongs to the k-th of the warps that may
    // blend the entry.
    uint32_t took_part[kBatch];
};

template <bool kWithSize>
struct Shared {
    Record<float> record[kBatch + 1];  // the last element is an invisible record for
                                       // padding
    uint32_t warps[kBatch];            // bit w: warp w may blend the entry
    // Indices of entries that a warp may blend, padded with kBatch.
    uint8_t list[kWarps][kBatch + kHeld];
    uint32_t pairs_of_warp[kBatch / 32];
    uint32_t alive;  // bit w: a pixel of warp w has not stopped
    float4 d_color[kWarps][kWarpHeight]
                  // Gradients with respect to colour and depth. The extra column avoids
                  // bank conflicts.
                  [kWarpWidth + 1];
    Share share[kWarps][kHeld * kShareStride];
    Batch batch[2];  // while one batch is blended, the previous one is summed
    float pair[kPairs][kValuesOf<kWithSize>];
    float d_background[kWarps][3];
};

static_assert(sizeof(Shared<true>) <= 99 * 1024,
              "some devices have 99 KiB of shared memory per block");

// Returns a mask of the warps whose pixels the record may reach. It does not round to
// pixel centres. A tile marks the gradient slots of all records that it lists for a
// warp. Therefore this test decides which gaussians get a gradient; that gradient may
// be zero.
__device__ uint32_t warps_of(const Record<float>& g, int left, int top) {
    const int x0 = max(g.x0 - left, 0) / kWarpWidth,
              x1 = min(g.x1 - left, kFrameTileWidth - 1) / kWarpWidth;
    const int y0 = max(g.y0 - top, 0) / kWarpHeight,
              y1 = min(g.y1 - top, kFrameTileHeight - 1) / kWarpHeight;
    const EllipseRows<float> ellipse = ellipse_rows(g.l11, g.l12, g.l22, g.log2_opacity);
    const float u = g.u - left,
                // relative to the tile's corner; pixel centres are at 1/2
        v = g.v - top;
    uint32_t warps = 0;
    for (int y = y0; y <= y1; ++y) {
        float low, high;
        row_extent(ellipse, kWarpHeight * y + 0.5f - v, kWarpHeight * y + kWarpHeight - 0.5f - v,
                   low, high);
        for (int x = x0; x <= x1; ++x)
            if (u + high >= kWarpWidth * x + 0.5f && u + low <= kWarpWidth * x + kWarpWidth - 0.5f)
                warps |= 1u << (y * kWarpColumns + x);
    }
    return warps;
}

// The state of a pixel in the backward pass.
struct PixelGradient {
    float x, y;
    float d_color[3], d_depth, d_weight;
    float total,
        // Sums of weight * (gradient with respect to the weight). `total` covers all
        // gaussians, `running` those visited so far.
        running;
    float transmittance;
};

// Reads the pixel at (column, row) of the picture. Adds its part of the gradient of the
// background to `d_background`.
__device__ PixelGradient read_pixel(const FrameImage& image,
                                    const PictureGradient<float>& d_picture, int column, int row,
                                    float d_background[3]) {
    PixelGradient p{.x = column + 0.5f,
                    .y = row + 0.5f,
                    .d_color = {0, 0, 0},
                    .d_depth = 0,
                    .d_weight = 0,
                    .total = 0,
                    .running = 0,
                    .transmittance = -1};
    if (column >= image.width || row >= image.height) return p;
    const size_t pixel = static_cast<size_t>(row) * image.width + column;
    const float alpha = image.planes.alpha[pixel];
    const float t = 1 - alpha;
    p.transmittance = 1;
    p.d_weight = d_picture.alpha[pixel];
    for (int c = 0; c < 3; ++c) {
        const float d = d_picture.color[3 * pixel + c];
        p.d_color[c] = d;
        p.d_weight -= d * image.background[c];
        p.total += d * (image.planes.color[3 * pixel + c] - t * image.background[c]);
        d_background[c] = d * t;
    }
    if (d_picture.depth != nullptr && alpha > 0) {
        const float depth = image.planes.depth[pixel];
        p.d_depth = d_picture.depth[pixel] / alpha;
        p.d_weight -= p.d_depth * depth;
        p.total += p.d_depth * depth * alpha;
    }
    p.total += p.d_weight * alpha;
    return p;
}

// Sums the contributions of the warp's pixels to the gradients of `held` gaussians. The
// lane with index kHeld * r + k sums row r of the pixels for gaussian k; `entry` is the
// index of that gaussian in the batch. (left, top) is the centre of the warp's first
// pixel.
template <bool kWithDepth, bool kWithSize>
__device__ void add_up(Shared<kWithSize>& s, Batch& batch, int warp, int held, int entry,
                       float left, float top) {
    const int lane = threadIdx.x % 32, gaussian = lane % kHeld, row = lane / kHeld;
    __syncwarp();
    const Record<float>& g = s.record[entry];
    const float u = g.u - left, v = g.v - top, l11 = g.l11, l12 = g.l12, l22 = g.l22;
    const Share* shares = &s.share[warp][gaussian * kShareStride + kWarpWidth * row];
    const float4* d_colors = s.d_color[warp][row];
    RowSums<float> sums{};
    CenterSize<float> size{};
    float color[3] = {0, 0, 0}, depth = 0;
    Falloff<float> f;
#pragma unroll
    for (int i = 0; i < kWarpWidth; ++i) {
        const Share share = shares[i];
        const float4 d_color = d_colors[i];
        f = falloff_at(float(i), float(row), u, v, l11, l12, l22, 0.0f);
        sums.add(f, share.d_exponent);
        if (kWithSize) size += size_of_center_vjp(l11, l12, l22, f, share.d_exponent);
        color[0] += d_color.x * share.weight;
        color[1] += d_color.y * share.weight;
        color[2] += d_color.z * share.weight;
        if (kWithDepth) depth += d_color.w * share.weight;
    }
    const Ellipse<float> d = falloff_vjp(l11, l12, l22, sums.of_falloff(f));

    // The sums of rows overwrite the contributions. Lane l then sums the values with
    // the indices l / kHeld, l / kHeld + 4, and so on.
    constexpr int kValues = kValuesOf<kWithSize>;
    const float value[kValuesOf<true>] = {
        d.u,   d.v,      d.l11,    d.l12,    d.l22,  d.log2_opacity,
        depth, color[0], color[1], color[2], size.u, size.v};
    float* of_rows = reinterpret_cast<float*>(s.share[warp]);
    __syncwarp();
#pragma unroll
    for (int k = 0; k < kValues; ++k) of_rows[kRowsStride * k + lane] = value[k];
    __syncwarp();
    if (gaussian < held) {
        const uint32_t rank = __popc(s.warps[entry] & ((1u << warp) - 1));
        float* pair = s.pair[batch.first_pair[entry] + rank];
#pragma unroll
        for (int k = row; k < kValues; k += kWarpHeight) {
            const float* rows = of_rows + kRowsStride * k + gaussian;
            pair[k] = (rows[0] + rows[kHeld]) + (rows[2 * kHeld] + rows[3 * kHeld]);
        }
        if (row == 0) atomicOr(&batch.took_part[entry], 1u << rank);
    }
    __syncwarp();
}

// Blends a gaussian over the pixel, and returns the pixel's contribution to the
// gaussian's gradient.
template <bool kWithDepth>
__device__ Share blend_vjp(const Record<float>& g, PixelGradient& p) {
    const Falloff<float> f = falloff_at(p.x, p.y, g.u, g.v, g.l11, g.l12, g.l22, g.log2_opacity);
    const float alpha = alpha_of(f), before = p.transmittance;
    const float weight = blend_weight(alpha, p.transmittance);
    float by_weight = p.d_weight;
    for (int c = 0; c < 3; ++c) by_weight += p.d_color[c] * g.color[c];
    if (kWithDepth) by_weight += p.d_depth * g.depth;
    p.running += weight * by_weight;
    return {exponent_vjp(alpha, before, weight, by_weight, p.total - p.running), weight};
}

// Blends the batch over the pixels of this warp.
template <bool kWithDepth, bool kWithSize>
__device__ void blend_batch_vjp(Shared<kWithSize>& s, Batch& batch, int warp, int num,
                                PixelGradient& p, float left, float top) {
    const int lane = threadIdx.x % 32;
    uint8_t* list = s.list[warp];
    int count = 0;
    for (int first = 0; first < num; first += 32) {
        const bool meets = first + lane < num && (s.warps[first + lane] >> warp & 1) != 0;
        const unsigned entries = __ballot_sync(kAllLanes, meets);
        if (meets)
            list[count + __popc(entries & ((1u << lane) - 1))] = static_cast<uint8_t>(first + lane);
        count += __popc(entries);
    }
    if (lane < kHeld) list[count + lane] = kBatch;
    __syncwarp();

    Share* shares = &s.share[warp][lane];
    bool alive = true;
    for (int first = 0; first < count && alive; first += kHeld) {
        const int held = min(kHeld, count - first);
        for (int h = 0; h < held; h += kTogether) {
            // Store all shares after the last load, so that the loads can overlap.
            Share share[kTogether];
#pragma unroll
            for (int k = 0; k < kTogether; ++k)
                share[k] = blend_vjp<kWithDepth>(s.record[list[first + h + k]], p);
#pragma unroll
            for (int k = 0; k < kTogether; ++k) shares[(h + k) * kShareStride] = share[k];
        }
        add_up<kWithDepth, kWithSize>(s, batch, warp, held, list[first + lane % kHeld], left, top);
        alive = __any_sync(kAllLanes, p.transmittance > 0) != 0;
    }
    if (!alive && lane == 0) atomicAnd(&s.alive, ~(1u << warp));
}

// Sums the pairs of each entry of a batch, and writes the gradient slots. `num_threads`
// threads share the work.
template <bool kWithSize>
__device__ void add_up_pairs(const Shared<kWithSize>& s, const Batch& batch, int num, int thread,
                             int num_threads, const GradientSlots& slots) {
    constexpr int kValues = kValuesOf<kWithSize>;
    for (int i = thread; i < num * kValues; i += num_threads) {
        const int entry = i / kValues, value = i % kValues;
        const uint32_t took_part = batch.took_part[entry];
        if (took_part == 0) continue;
        const float* pair = &s.pair[batch.first_pair[entry]][value];
        float sum = 0;
        for (uint32_t todo = took_part; todo != 0; todo &= todo - 1)
            sum += pair[(__ffs(todo) - 1) * kValues];
        const uint32_t slot = batch.slot[entry];
        if (kWithSize && value >= kGradientValues)
            reinterpret_cast<float*>(slots.size + slot)[value - kGradientValues] = sum;
        else
            reinterpret_cast<float*>(slots.slot + slot)[value] = sum;
        if (value == 0) slots.is_touched[slot] = 1;
    }
}

// Return the image and the gradient of a picture. The template parameter tells whether
// the picture is part of a batch; if not, the compiler can read it from constant
// memory.
template <bool kIsBatch>
__device__ const FrameImage& image_of(const RasterizeBackwardInput& in, const PictureBatch& batch,
                                      uint32_t image) {
    if constexpr (kIsBatch) return batch.images[image];
    return in.image;
}
template <bool kIsBatch>
__device__ const PictureGradient<float>& gradient_of(const RasterizeBackwardInput& in,
                                                     const PictureBatch& batch, uint32_t image) {
    if constexpr (kIsBatch) return batch.d_pictures[image];
    return in.d_picture;
}

// Launched with one block per tile. `d_background_of_tile` may be null for a batch.
template <bool kWithDepth, bool kWithSize, bool kIsBatch>
__global__ void __launch_bounds__(kThreads, 2)
    rasterize_backward_kernel(RasterizeBackwardInput in, PictureBatch batch, GradientSlots slots,
                              float* d_background_of_tile) {
    Shared<kWithSize>& s = *reinterpret_cast<Shared<kWithSize>*>(shared_memory());
    const int lane = threadIdx.x % 32;
    const int warp = __shfl_sync(kAllLanes, static_cast<int>(threadIdx.x) / 32,
                                 // The shuffle shows the compiler that all lanes have
                                 // the same value.
                                 0);
    const uint32_t tile = in.plans[blockIdx.x].tile;
    const uint32_t number = in.plans[blockIdx.x].image;
    const FrameImage& image = image_of<kIsBatch>(in, batch, number);
    const uint32_t in_image = tile - image.first_tile;
    const int tile_column = in_image % image.tile_columns;
    const int tile_row = in_image / image.tile_columns;
    const int left = tile_column * kFrameTileWidth, top = tile_row * kFrameTileHeight;
    const int warp_left = left + warp % kWarpColumns * kWarpWidth,
              warp_top = top + warp / kWarpColumns * kWarpHeight;

    float d_background[3] = {0, 0, 0};
    PixelGradient p =
        read_pixel(image, gradient_of<kIsBatch>(in, batch, number), warp_left + lane % kWarpWidth,
                   warp_top + lane / kWarpWidth, d_background);
    s.d_color[warp][lane / kWarpWidth][lane % kWarpWidth] =
        make_float4(p.d_color[0], p.d_color[1], p.d_color[2], p.d_depth);
    for (int c = 0; c < 3; ++c) {
        const float sum = warp_sum(d_background[c]);
        if (lane == 0) s.d_background[warp][c] = sum;
    }
    if (threadIdx.x == 0) {
        s.alive = (1u << kWarps) - 1;
        s.record[kBatch] = {};
        s.record[kBatch].log2_opacity = -INFINITY;
    }
    __syncthreads();
    if ((!kIsBatch || d_background_of_tile != nullptr) && threadIdx.x < 3) {
        float sum = 0;
        for (int w = 0; w < kWarps; ++w) sum += s.d_background[w][threadIdx.x];
        d_background_of_tile[3 * tile + threadIdx.x] = sum;
    }

    const uint32_t* order = in.order + in.tile_first[tile];
    const int count = in.blended[tile];
    const int i = threadIdx.x;
    int first = 0, num = 0;
    for (int turn = 0;; turn ^= 1) {
        // Some warps sum the pairs of the previous batch, while the other warps load
        // this batch.
        const bool goes_on = first < count && s.alive != 0;
        Batch& entries = s.batch[turn];
        uint32_t end_pair = 0;
        if (i >= kBatch) {
            add_up_pairs(s, s.batch[turn ^ 1], num, i - kBatch, kThreads - kBatch, slots);
        } else if (goes_on) {
            uint32_t warps = 0;
            if (first + i < count) {
                const uint32_t r = order[first + i];
                const Record<float> g = load_record(in.records, r, in.records.box[r]);
                s.record[i] = g;
                entries.slot[i] =
                    slots.first[r] + slot_of_tile(in.records.box[r], tile_column, tile_row);
                warps = warps_of(g, left, top) & s.alive;
            }
            s.warps[i] = warps;
            entries.took_part[i] = 0;
            end_pair = warp_prefix<32, uint32_t>(__popc(warps));
            if (lane == 31) s.pairs_of_warp[warp] = end_pair;
        }
        if (!goes_on) break;
        __syncthreads();
        if (i < kBatch) {
            for (int w = 0; w < warp; ++w) end_pair += s.pairs_of_warp[w];
            entries.first_pair[i] = end_pair - __popc(s.warps[i]);
        }
        // Add entries to the batch while there is room for their (entry, warp) pairs.
        num = __syncthreads_count(i < min(kBatch, count - first) && end_pair <= kPairs);
        blend_batch_vjp<kWithDepth, kWithSize>(s, entries, warp, num, p, warp_left + 0.5f,
                                               warp_top + 0.5f);
        first += num;
        __syncthreads();
    }
}

template <bool kWithDepth, bool kWithSize>
void start(const RasterizeBackwardInput& in, const GradientSlots& slots,
           float* d_background_of_tile, cudaStream_t stream) {
    launch("rasterize_backward_kernel", &rasterize_backward_kernel<kWithDepth, kWithSize, false>,
           in.image.tile_columns * in.image.tile_rows, kThreads, sizeof(Shared<kWithSize>), stream,
           in, PictureBatch{}, slots, d_background_of_tile);
}

template <bool kWithDepth, bool kWithSize>
void start_batch(const RasterizeBackwardInput& in, const PictureBatch& batch,
                 const GradientSlots& slots, float* d_background_of_tile, cudaStream_t stream) {
    launch("rasterize_backward_kernel", &rasterize_backward_kernel<kWithDepth, kWithSize, true>,
           batch.num_tiles, kThreads, sizeof(Shared<kWithSize>), stream, in, batch, slots,
           d_background_of_tile);
}

constexpr int kSumThreads = 256;

// Sums the background gradients of the tiles of each image. Launched with one block per
// image and channel.
__global__ void sum_over_tiles_kernel(const float* of_tile, uint32_t num_tiles, float* total) {
    __shared__ float of_warp[kSumThreads / 32];
    const uint32_t image = blockIdx.x / 3, channel = blockIdx.x % 3;
    const float* of_image = of_tile + 3 * static_cast<uint64_t>(num_tiles) * image;
    float sum = 0;
    for (uint32_t t = threadIdx.x; t < num_tiles; t += kSumThreads)
        sum += of_image[3 * t + channel];
    sum = warp_sum(sum);
    if (threadIdx.x % 32 == 0) of_warp[threadIdx.x / 32] = sum;
    __syncthreads();
    if (threadIdx.x != 0) return;
    for (int w = 1; w < kSumThreads / 32; ++w) sum += of_warp[w];
    total[blockIdx.x] = sum;
}

}  // namespace

void rasterize_backward(const RasterizeBackwardInput& in, const GradientSlots& slots,
                        float* d_background_of_tile, float* d_background, cudaStream_t stream) {
    const unsigned num_tiles = in.image.tile_columns * in.image.tile_rows;
    const bool with_depth = in.d_picture.depth != nullptr;
    const auto run = slots.size != nullptr ? with_depth ? &start<true, true> : &start<false, true>
                     : with_depth          ? &start<true, false>
                                           : &start<false, false>;
    run(in, slots, d_background_of_tile, stream);
    launch("sum_over_tiles_kernel", &sum_over_tiles_kernel, 3, kSumThreads, 0, stream,
           d_background_of_tile, num_tiles, d_background);
}

void rasterize_backward(const RasterizeBackwardInput& in, const PictureBatch& batch,
                        const GradientSlots& slots, float* d_background_of_tile,
                        float* d_background, cudaStream_t stream) {
    const auto run = slots.size != nullptr
                         ? batch.has_depth ? &start_batch<true, true> : &start_batch<false, true>
                     : batch.has_depth ? &start_batch<true, false>
                                       : &start_batch<false, false>;
    run(in, batch, slots, d_background_of_tile, stream);
    if (d_background == nullptr) return;
    launch("sum_over_tiles_kernel", &sum_over_tiles_kernel, 3 * batch.num_images, kSumThreads, 0,
           stream, d_background_of_tile, batch.num_tiles / batch.num_images, d_background);
}

}  // namespace cuda
}  // namespace v3dg

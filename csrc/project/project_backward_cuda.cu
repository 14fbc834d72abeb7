// The backward pass of projection on CUDA. A block processes an item, and a thread one
// record. The block loads the SH coefficients of its gaussians into shared memory, and
// overwrites them there with their gradients.

#include <type_traits>

#include "base/scan.cuh"
#include "project/project_backward.h"
#include "project/project_math.h"
#include "project/slot_sums.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kThreads = kItemSize;
// number of SH words that a thread loads before it stores any of them
constexpr int kWordsAtOnce = 6;

__global__ void place_slots_kernel(ItemList items, const uint32_t* item_records,
                                   const RecordBox* boxes, uint32_t* first_slot) {
    if (!items.is_complete()) return;
    const unsigned long long num_items = items.counters->items;
    __shared__ uint32_t sum_of_warp[kThreads / 32];
    __shared__ uint32_t first_of_item;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    for (unsigned long long i = blockIdx.x; i < num_items; i += gridDim.x) {
        const uint32_t record = items.items[i].record + threadIdx.x;
        const bool is_record = threadIdx.x < item_records[i];
        const uint32_t num = is_record ? num_tiles_of(boxes[record]) : 0;
        const uint32_t end = warp_prefix(num);
        if (lane == 31) sum_of_warp[warp] = end;
        __syncthreads();
        if (threadIdx.x == 0) {
            uint32_t sum = 0;
            for (uint32_t& of_warp : sum_of_warp) {
                const uint32_t here = of_warp;
                of_warp = sum;
                sum += here;
            }
            first_of_item = static_cast<uint32_t>(
                atomicAdd(&items.counters->slots, static_cast<unsigned long long>(sum)));
        }
        __syncthreads();
        if (is_record) first_slot[record] = first_of_item + sum_of_warp[warp] + end - num;
        __syncthreads();
    }
}

// The layout of a row of SH coefficients in shared memory. The stride is odd to avoid
// bank conflicts.
template <int kDegree>
struct ShRow {
    static constexpr int kValues = 3 * num_sh_bases(kDegree);
    using Word = std::conditional_t<kValues % 4 == 0, float4, float>;
    static constexpr int kWords = kValues * sizeof(float) / sizeof(Word);
    static constexpr int kStride = kWords | 1;
};

// The rows of the gaussians that a block processes.
struct BlockRows {
    uint64_t first;  // row of the first gaussian
    int count;
};
template <bool kIsBatch>
__device__ BlockRows rows_of_block(const ProjectBackwardInput& in, const ItemBatch& batch) {
    if constexpr (kIsBatch) {
        const DrawItem& item = batch.items[blockIdx.x];
        return {item.first, static_cast<int>(item.count)};
    }
    const uint64_t first = static_cast<uint64_t>(blockIdx.x) * kItemSize;
    return {first, static_cast<int>(min(static_cast<uint64_t>(kItemSize), in.rows.size - first))};
}
// The template parameter lets the compiler read the view of a single picture from
// constant memory.
template <bool kIsBatch>
__device__ const ModelView<float>& view_of_block(const ProjectBackwardInput& in,
                                                 const ItemBatch& batch) {
    if constexpr (kIsBatch) return batch.placements[batch.items[blockIdx.x].placement].view;
    return in.view;
}
template <bool kIsBatch, class C>
__device__ const C& camera_of_block(const ProjectBackwardInput& in, const ItemBatch& batch) {
    if constexpr (kIsBatch)
        return batch.images[batch.placements[batch.items[blockIdx.x].placement].image].camera;
    return in.camera;
}

template <int kDegree, bool kIsBatch, class C>
__global__ void __launch_bounds__(kThreads, kDegree < 3 ? 4 : 3)
    project_backward_kernel(ProjectBackwardInput in, ItemBatch batch, GradientSlots slots,
                            GaussianRows<float> out, float* d_centers) {
    using Row = ShRow<kDegree>;
    using Word = typename Row::Word;
    Word* sh_rows = reinterpret_cast<Word*>(shared_memory());
    __shared__ bool is_used[kThreads];  // whether the gaussian has a gradient
    const BlockRows block = rows_of_block<kIsBatch>(in, batch);
    const uint64_t first = block.first,
                   first_record = static_cast<uint64_t>(blockIdx.x) * kItemSize;
    const int num_here = block.count;
    if (kIsBatch && first < batch.first_wanted) return;
    is_used[threadIdx.x] = false;
    __syncthreads();

    const uint64_t record = first_record + threadIdx.x;
    const bool is_record = threadIdx.x < in.item_records[blockIdx.x];
    const uint64_t i = is_record ? in.source[record] : 0;  // gaussian of the record
    Gaussian3d<float> g{};
    float color[3] = {0, 0, 0};
    if (is_record) {  // these loads are in flight while the slots are summed
        load_row(in.rows.means, i, g.mean);
        load_row(in.rows.quats, i, g.quat);
        load_row(in.rows.scales, i, g.scale);
        g.opacity = in.rows.opacities[i];
        const float2 red_green =
            reinterpret_cast<const float2*>(in.records.ellipse)[4 * record + 3];
        color[0] = red_green.x;
        color[1] = red_green.y;
        color[2] = in.records.rest[2 * record];
    }
    RecordGradient<float> d{};
    const bool used = sum_of_slots(slots, slots.slot, is_record ? slots.first[record] : 0,
                                   is_record ? num_tiles_of(in.records.box[record]) : 0, d);
    if (used) {
        is_used[i - first] = true;
        const float center[2] = {d.ellipse.u, d.ellipse.v};
        if (d_centers != nullptr) store_row<2>(d_centers, i, center);
    }
    __syncthreads();
    const Word* sh_in = reinterpret_cast<const Word*>(in.rows.sh + Row::kValues * first);
    const auto is_wanted = [&](int k) {
        return k < Row::kWords * num_here && is_used[k / Row::kWords];
    };
#pragma unroll
    for (int begin = 0; begin < Row::kWords; begin += kWordsAtOnce) {
        Word words[kWordsAtOnce];
#pragma unroll
        for (int w = 0; w < kWordsAtOnce && begin + w < Row::kWords; ++w) {
            const int k = (begin + w) * kThreads + threadIdx.x;
            if (is_wanted(k)) words[w] = sh_in[k];
        }
#pragma unroll
        for (int w = 0; w < kWordsAtOnce && begin + w < Row::kWords; ++w) {
            const int k = (begin + w) * kThreads + threadIdx.x;
            if (is_wanted(k)) sh_rows[k / Row::kWords * Row::kStride + k % Row::kWords] = words[w];
        }
    }
    __syncthreads();

    // Without a batch, the output row of a gaussian is its row in the model. In a
    // batch, each item has output rows of its own.
    const uint64_t first_out = kIsBatch ? first_record : first;
    if (used) {
        const ModelView<float>& view = view_of_block<kIsBatch>(in, batch);
        const C& camera = camera_of_block<kIsBatch, C>(in, batch);
        const uint64_t row_out = first_out + (i - first);
        Projection<float, C> s;
        to_view(view, g.mean, s.p);
        const Ellipse<float> e =
            project_gaussian(g, view, camera, in.filter_px2, in.antialiased, s);
        Gaussian3d<float> d_gaussian =
            project_gaussian_vjp(g, view, camera, in.filter_px2, in.antialiased, s, e, d.ellipse);
        Word words[Row::kWords];
        Word* row = sh_rows + (i - first) * Row::kStride;
        for (int k = 0; k < Row::kWords; ++k) words[k] = row[k];
        float* sh = reinterpret_cast<float*>(words);
        float direction[3];
        from_eye(view, g.mean, direction);
        color_of_sh_vjp(kDegree, direction, sh, color, d.color, d_gaussian.mean, sh);
        for (int k = 0; k < Row::kWords; ++k) row[k] = words[k];
        store_row<3>(out.means, row_out, d_gaussian.mean);
        store_row<4>(out.quats, row_out, d_gaussian.quat);
        store_row<3>(out.scales, row_out, d_gaussian.scale);
        out.opacities[row_out] = d_gaussian.opacity;
    }
    if (static_cast<int>(threadIdx.x) < num_here && !is_used[threadIdx.x]) {
        const float zeros[4] = {0, 0, 0, 0};
        store_row<3>(out.means, first_out + threadIdx.x, zeros);
        store_row<4>(out.quats, first_out + threadIdx.x, zeros);
        store_row<3>(out.scales, first_out + threadIdx.x, zeros);
        out.opacities[first_out + threadIdx.x] = 0;
        if (d_centers != nullptr) store_row<2>(d_centers, first + threadIdx.x, zeros);
    }
    __syncthreads();
    Word* sh_out = reinterpret_cast<Word*>(out.sh + Row::kValues * first_out);
    for (int k = threadIdx.x; k < Row::kWords * num_here; k += kThreads)
        sh_out[k] = is_used[k / Row::kWords]
                        ? sh_rows[k / Row::kWords * Row::kStride + k % Row::kWords]
                        : Word{};
}

// Sums the sizes of the gradients of each gaussian's centre. `sizes` must initially be
// zero.
__global__ void __launch_bounds__(kThreads)
    center_sizes_kernel(ProjectBackwardInput in, GradientSlots slots, CenterSize<float>* sizes) {
    const uint64_t record = static_cast<uint64_t>(blockIdx.x) * kItemSize + threadIdx.x;
    const bool is_record = threadIdx.x < in.item_records[blockIdx.x];
    CenterSize<float> size{};
    if (sum_of_slots(slots, slots.size, is_record ? slots.first[record] : 0,
                     is_record ? num_tiles_of(in.records.box[record]) : 0, size))
        sizes[in.source[record]] = size;
}

template <int kDegree, bool kIsBatch, class C>
void start_by(const ProjectBackwardInput& in, const ItemBatch& batch, const GradientSlots& slots,
              const GaussianRows<float>& out, float* d_centers, cudaStream_t stream) {
    launch("project_backward_kernel", &project_backward_kernel<kDegree, kIsBatch, C>,
           kIsBatch ? batch.num_items : blocks_for(in.rows.size, kItemSize), kThreads,
           kThreads * ShRow<kDegree>::kStride * sizeof(typename ShRow<kDegree>::Word), stream, in,
           batch, slots, out, d_centers);
}

template <int kDegree, bool kIsBatch>
void start(const ProjectBackwardInput& in, const ItemBatch& batch, const GradientSlots& slots,
           const GaussianRows<float>& out, float* d_centers, cudaStream_t stream) {
    if (in.has_lenses)
        start_by<kDegree, kIsBatch, Intrinsics<float>>(in, batch, slots, out, d_centers, stream);
    else
        start_by<kDegree, kIsBatch, Pinhole<float>>(in, batch, slots, out, d_centers, stream);
}

template <bool kIsBatch>
void start_of_degree(const ProjectBackwardInput& in, const ItemBatch& batch,
                     const GradientSlots& slots, const GaussianRows<float>& out, float* d_centers,
                     cudaStream_t stream) {
    switch (in.rows.sh_degree) {
        case kPlainColor:
            return start<kPlainColor, kIsBatch>(in, batch, slots, out, d_centers, stream);
        case 0: return start<0, kIsBatch>(in, batch, slots, out, d_centers, stream);
        case 1: return start<1, kIsBatch>(in, batch, slots, out, d_centers, stream);
        case 2: return start<2, kIsBatch>(in, batch, slots, out, d_centers, stream);
        default: return start<3, kIsBatch>(in, batch, slots, out, d_centers, stream);
    }
}

}  // namespace

void place_slots(const ItemList& items, const uint32_t* item_records, const RecordBox* boxes,
                 uint32_t* first_slot, cudaStream_t stream) {
    launch("place_slots_kernel", &place_slots_kernel, 8 * num_multiprocessors(), kThreads, 0,
           stream, items, item_records, boxes, first_slot);
}

void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianRows<float>& out, const CenterGradients<float>& centers,
                      cudaStream_t stream) {
    if (centers.size != nullptr) {
        check(cudaMemsetAsync(centers.size, 0, in.rows.size * sizeof *centers.size, stream),
              "cudaMemsetAsync");
        launch("center_sizes_kernel", &center_sizes_kernel, blocks_for(in.rows.size, kItemSize),
               kThreads, 0, stream, in, slots, centers.size);
    }
    start_of_degree<false>(in, {}, slots, out, centers.sum, stream);
}

void project_backward(const ProjectBackwardInput& in, const ItemBatch& batch,
                      const GradientSlots& slots, const GaussianRows<float>& out,
                      cudaStream_t stream) {
    start_of_degree<true>(in, batch, slots, out, nullptr, stream);
}

}  // namespace cuda
}  // namespace v3dg

// A block takes an item, a thread one of its gaussians. The gaussians' SH coefficients go through shared
// memory, a row each, and become their own gradients there.

#include "base/launch.cuh"
#include "project/project_backward.h"
#include "project/project_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kThreads = kItemSize;
constexpr uint32_t kFewSlots = 16;  // a thread adds up so many by itself, a warp more
constexpr uint32_t kNone = 0xffffffffu;

__device__ void add_slot(const GradientSlots& slots, uint32_t slot, RecordGradient<float>& sum,
                         bool& is_touched) {
    if (slots.is_touched[slot] == 0) return;
    sum += slots.slot[slot];
    is_touched = true;
}

// Sum of `num` slots, in their order or, when there are many, in another that is fixed as well. All lanes of
// the warp take part. Returns whether any was touched.
__device__ bool sum_of_slots(const GradientSlots& slots, uint32_t first, uint32_t num,
                             RecordGradient<float>& sum) {
    const int lane = threadIdx.x % 32;
    bool is_touched = false;
    if (num <= kFewSlots)
        for (uint32_t i = 0; i < num; ++i) add_slot(slots, first + i, sum, is_touched);
    for (unsigned many = __ballot_sync(kAllLanes, num > kFewSlots); many != 0; many &= many - 1) {
        const int owner = __ffs(many) - 1;
        const uint32_t begin = __shfl_sync(kAllLanes, first, owner),
                       end = begin + __shfl_sync(kAllLanes, num, owner);
        RecordGradient<float> part{};
        bool part_touched = false;
        for (uint32_t i = begin + lane; i < end; i += 32) add_slot(slots, i, part, part_touched);
        float* value = reinterpret_cast<float*>(&part);
        for (size_t k = 0; k < sizeof part / sizeof(float); ++k) value[k] = warp_sum(value[k]);
        part_touched = __any_sync(kAllLanes, part_touched) != 0;
        if (lane == owner) {
            sum = part;
            is_touched = part_touched;
        }
    }
    return is_touched;
}

__global__ void place_slots_kernel(ProjectBackwardInput in, uint32_t* first_slot,
                                   unsigned long long* num_slots) {
    __shared__ uint32_t sum_of_warp[kThreads / 32];
    __shared__ uint32_t first_of_item;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const uint32_t record = blockIdx.x * kItemSize + threadIdx.x;
    const bool is_record = threadIdx.x < in.item_records[blockIdx.x];
    const uint32_t num = is_record ? num_slots_of(in.records[record]) : 0;
    uint32_t end = num;
    for (int offset = 1; offset < 32; offset *= 2) {
        const uint32_t before = __shfl_up_sync(kAllLanes, end, offset);
        if (lane >= offset) end += before;
    }
    if (lane == 31) sum_of_warp[warp] = end;
    __syncthreads();
    if (threadIdx.x == 0) {
        uint32_t sum = 0;
        for (uint32_t& of_warp : sum_of_warp) {
            const uint32_t here = of_warp;
            of_warp = sum;
            sum += here;
        }
        first_of_item = static_cast<uint32_t>(atomicAdd(num_slots, static_cast<unsigned long long>(sum)));
    }
    __syncthreads();
    if (is_record) first_slot[record] = first_of_item + sum_of_warp[warp] + end - num;
}

template <int kWidth>
__device__ void load_row(const float* rows, uint64_t i, float (&row)[kWidth]) {
#pragma unroll
    for (int k = 0; k < kWidth; ++k) row[k] = rows[kWidth * i + k];
}
template <int kWidth>
__device__ void store_row(float* rows, uint64_t i, const float (&row)[kWidth]) {
#pragma unroll
    for (int k = 0; k < kWidth; ++k) rows[kWidth * i + k] = row[k];
}

template <int kDegree>
constexpr int kNumSh = 3 * num_sh_bases(kDegree);
template <int kDegree>
constexpr int kShStride = kNumSh<kDegree> | 1;  // odd, against bank conflicts

template <int kDegree>
__global__ void __launch_bounds__(kThreads)
    project_backward_kernel(ProjectBackwardInput in, GradientSlots slots, GaussianGradients<float> out) {
    constexpr int kWidth = kNumSh<kDegree>, kStride = kShStride<kDegree>;
    float* sh_rows = reinterpret_cast<float*>(shared_memory());
    __shared__ uint32_t record_of[kThreads];
    __shared__ bool is_used[kThreads];  // whether anything flows into it
    const uint64_t first = static_cast<uint64_t>(blockIdx.x) * kItemSize, i = first + threadIdx.x;
    record_of[threadIdx.x] = kNone;
    __syncthreads();
    if (threadIdx.x < in.item_records[blockIdx.x]) {
        const uint32_t record = static_cast<uint32_t>(first) + threadIdx.x;
        record_of[in.source[record] - first] = record;
    }
    __syncthreads();

    const uint32_t record = record_of[threadIdx.x];
    RecordGradient<float> d{};
    const bool used = sum_of_slots(slots, record == kNone ? 0 : slots.first[record],
                                   record == kNone ? 0 : num_slots_of(in.records[record]), d);
    is_used[threadIdx.x] = used;
    __syncthreads();
    const int num_values = kWidth * static_cast<int>(min(static_cast<uint64_t>(kItemSize), in.size - first));
    const float* sh_in = in.model.sh + kWidth * first;
    for (int k = threadIdx.x; k < num_values; k += kThreads)
        if (is_used[k / kWidth]) sh_rows[k / kWidth * kStride + k % kWidth] = sh_in[k];
    __syncthreads();

    Gaussian3d<float> d_gaussian{};
    if (used) {
        Gaussian3d<float> g;
        load_row(in.model.means, i, g.mean);
        load_row(in.model.quats, i, g.quat);
        load_row(in.model.scales, i, g.scale);
        g.opacity = in.model.opacities[i];
        Projection<float> s;
        const Ellipse<float> e = project_gaussian(g, in.view, in.camera, in.filter_px2, in.compensate, s);
        d_gaussian =
            project_gaussian_vjp(g, in.view, in.camera, in.filter_px2, in.compensate, s, e, d.ellipse);
        float* sh = sh_rows + threadIdx.x * kStride;
        color_of_sh_vjp(kDegree, g.mean, in.view, sh, in.records[record].color, d.color, d_gaussian.mean, sh);
    }
    if (i < in.size) {
        store_row(out.means, i, d_gaussian.mean);
        store_row(out.quats, i, d_gaussian.quat);
        store_row(out.scales, i, d_gaussian.scale);
        out.opacities[i] = d_gaussian.opacity;
    }
    __syncthreads();
    float* sh_out = out.sh + kWidth * first;
    for (int k = threadIdx.x; k < num_values; k += kThreads)
        sh_out[k] = is_used[k / kWidth] ? sh_rows[k / kWidth * kStride + k % kWidth] : 0.0f;
}

template <int kDegree>
void start(const ProjectBackwardInput& in, const GradientSlots& slots, const GaussianGradients<float>& out,
           cudaStream_t stream) {
    launch("project_backward", &project_backward_kernel<kDegree>, blocks_for(in.size, kItemSize), kThreads,
           kThreads * kShStride<kDegree> * sizeof(float), stream, in, slots, out);
}

}  // namespace

void place_slots(const ProjectBackwardInput& in, uint32_t* first_slot, unsigned long long* num_slots,
                 cudaStream_t stream) {
    launch("place_slots", &place_slots_kernel, blocks_for(in.size, kItemSize), kThreads, 0, stream, in,
           first_slot, num_slots);
}

void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianGradients<float>& out, cudaStream_t stream) {
    switch (in.model.sh_degree) {
        case 0: return start<0>(in, slots, out, stream);
        case 1: return start<1>(in, slots, out, stream);
        case 2: return start<2>(in, slots, out, stream);
        default: return start<3>(in, slots, out, stream);
    }
}

}  // namespace cuda
}  // namespace v3dg

// The backward pass of projection for several views. A block processes the gaussians of
// an item, one view after another, and a thread one record. The sums over views are in
// shared memory. A view adds to the row of a gaussian at most once, so the order of
// additions is the order of the views.

#include "project/pose_gradient.h"
#include "project/project_math.h"
#include "project/project_views_backward.h"
#include "project/slot_sums.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kThreads = kItemSize;
constexpr int kWarps = kThreads / 32;

// The sums of one gaussian in shared memory. The stride is odd to avoid bank conflicts.
template <int kDegree>
struct SumRow {
    static constexpr int kSh = 3 * num_sh_bases(kDegree);
    static constexpr int kMean = 0, kQuat = 3, kScale = 7, kOpacity = 10, kFirstSh = 11;
    static constexpr int kStride = (kFirstSh + kSh) | 1;
};

// Adds without contraction. So the sum has the same bits as if the gradients were
// stored first and added later.
template <int kWidth>
__device__ void add_row(float* sums, const float* row) {
#pragma unroll
    for (int k = 0; k < kWidth; ++k) sums[k] = __fadd_rn(sums[k], row[k]);
}

// Computes the gradients of gaussian i in one view from `d`, the gradient of its
// record. Adds them to `sums`, the gaussian's row in shared memory.
template <int kDegree, bool kWithPose>
__device__ void add_gaussian(const ProjectViewsInput& in, const ViewsGradients& out, uint32_t view,
                             uint64_t i, uint64_t record, const RecordGradient<float>& d,
                             float* sums, PoseSums<float>& pose) {
    using Row = SumRow<kDegree>;
    const GaussianRows<const float>& rows = in.models[in.has_model_for_each_view ? view : 0];
    const ModelView<float>& placed = in.placements[view].view;
    float d_point[3], d_axes[9], d_direction[3] = {0, 0, 0};
    const auto camera = probed<kWithPose>(in.images[view].camera.pinhole(), d_point, d_axes);
    Gaussian3d<float> g;
    load_row(rows.means, i, g.mean);
    load_row(rows.quats, i, g.quat);
    load_row(rows.scales, i, g.scale);
    g.opacity = rows.opacities[i];
    const float2 red_green = reinterpret_cast<const float2*>(in.records.ellipse)[4 * record + 3];
    const float color[3] = {red_green.x, red_green.y, in.records.rest[2 * record]};

    Projection<float, std::remove_const_t<decltype(camera)>> s;
    to_view(placed, g.mean, s.p);
    const Ellipse<float> e = project_gaussian(g, placed, camera, in.filter_px2, in.antialiased, s);
    Gaussian3d<float> d_gaussian =
        project_gaussian_vjp(g, placed, camera, in.filter_px2, in.antialiased, s, e, d.ellipse);
    float sh[Row::kSh];
    load_row(rows.sh, i, sh);
    float direction[3];
    from_eye(placed, g.mean, direction);
    color_of_sh_vjp(kDegree, direction, sh, color, d.color,
                    kWithPose ? d_direction : d_gaussian.mean, sh);
    if constexpr (kWithPose) {
        pose_vjp(g, placed, d_point, d_axes, d_direction, pose);
        add_row<3>(d_gaussian.mean, d_direction);
    }
    add_row<3>(sums + Row::kMean, d_gaussian.mean);
    add_row<4>(sums + Row::kQuat, d_gaussian.quat);
    add_row<3>(sums + Row::kScale, d_gaussian.scale);
    const uint64_t of_view = view * in.num_gaussians + i;
    if (out.has_opacities_for_each_view)
        out.rows.opacities[of_view] = d_gaussian.opacity;
    else
        add_row<1>(sums + Row::kOpacity, &d_gaussian.opacity);
    if (out.has_sh_for_each_view)
        store_row<Row::kSh>(out.rows.sh, of_view, sh);
    else
        add_row<Row::kSh>(sums + Row::kFirstSh, sh);
    if (out.centers.sum != nullptr) {
        const float center[2] = {d.ellipse.u, d.ellipse.v};
        store_row<2>(out.centers.sum, of_view, center);
    }
}

// Writes the sum over the block's threads, and thus over its gaussians, to `part`.
__device__ void sum_over_block(const PoseSums<float>& pose, float* part) {
    __shared__ float of_warp[kWarps][kPoseValues];
    const float* values = reinterpret_cast<const float*>(&pose);
#pragma unroll
    for (int k = 0; k < kPoseValues; ++k) {
        const float sum = warp_sum(values[k]);
        if (threadIdx.x % 32 == 0) of_warp[threadIdx.x / 32][k] = sum;
    }
    __syncthreads();
    if (threadIdx.x >= kPoseValues) return;
    float sum = 0;
    for (const auto& warp : of_warp) sum += warp[threadIdx.x];
    part[threadIdx.x] = sum;
}

// Initialises the sums of this thread's gaussian.
template <int kDegree>
__device__ void start_sums(const GaussianRows<float>& rows, uint64_t i, bool adds, float* sums) {
    using Row = SumRow<kDegree>;
    for (int k = 0; k < Row::kStride; ++k) sums[k] = 0;
    if (!adds) return;
    for (int k = 0; k < 3; ++k) sums[Row::kMean + k] = rows.means[3 * i + k];
    for (int k = 0; k < 4; ++k) sums[Row::kQuat + k] = rows.quats[4 * i + k];
    for (int k = 0; k < 3; ++k) sums[Row::kScale + k] = rows.scales[3 * i + k];
    sums[Row::kOpacity] = rows.opacities[i];
    for (int k = 0; k < Row::kSh; ++k) sums[Row::kFirstSh + k] = rows.sh[Row::kSh * i + k];
}

// `pose_parts` is (views, items, kPoseValues), and must initially be zero.
template <int kDegree, bool kWithPose>
__global__ void __launch_bounds__(kThreads, 2)
    project_views_backward_kernel(ProjectViewsInput in, GradientSlots slots, ViewsGradients out,
                                  bool adds, float* pose_parts) {
    using Row = SumRow<kDegree>;
    float* sums = reinterpret_cast<float*>(shared_memory());
    float* mine = sums + threadIdx.x * Row::kStride;
    const uint64_t first = static_cast<uint64_t>(blockIdx.x) * kItemSize;
    const uint64_t num_items = gridDim.x;
    const uint64_t own = first + threadIdx.x;  // the gaussian whose sums are `mine`
    const bool owns = own < in.num_gaussians;
    start_sums<kDegree>(out.rows, own, adds && owns, mine);

    for (uint32_t view = 0; view < in.num_views; ++view) {
        const uint64_t item = view * num_items + blockIdx.x;
        const uint32_t num_records = in.item_records[item];
        if (num_records == 0) continue;
        __syncthreads();  // the sums of the previous views are complete
        const uint64_t record = item * kItemSize + threadIdx.x;
        const bool is_record = threadIdx.x < num_records;
        const uint64_t i = is_record ? in.source[record] : 0;
        const uint32_t slot = is_record ? slots.first[record] : 0;
        const uint32_t num_slots = is_record ? num_tiles_of(in.records.box[record]) : 0;
        RecordGradient<float> d{};
        const bool is_used = sum_of_slots(slots, slots.slot, slot, num_slots, d);
        if (out.centers.size != nullptr) {
            CenterSize<float> size{};
            if (sum_of_slots(slots, slots.size, slot, num_slots, size))
                out.centers.size[view * in.num_gaussians + i] = size;
        }
        PoseSums<float> pose{};
        if (is_used)
            add_gaussian<kDegree, kWithPose>(in, out, view, i, record, d,
                                             sums + (i - first) * Row::kStride, pose);
        if constexpr (kWithPose) sum_over_block(pose, pose_parts + item * kPoseValues);
    }

    __syncthreads();
    if (!owns) return;
    store_row<3>(out.rows.means, own, mine + Row::kMean);
    store_row<4>(out.rows.quats, own, mine + Row::kQuat);
    store_row<3>(out.rows.scales, own, mine + Row::kScale);
    if (!out.has_opacities_for_each_view) out.rows.opacities[own] = mine[Row::kOpacity];
    if (!out.has_sh_for_each_view) store_row<Row::kSh>(out.rows.sh, own, mine + Row::kFirstSh);
}

// Sums the parts of each view's pose. A block processes a view, and a warp one value.
__global__ void poses_kernel(const float* parts, uint32_t num_parts, const Placement* placements,
                             float* poses) {
    __shared__ PoseSums<double> sums;
    const uint32_t value = threadIdx.x / 32;
    const float* of_view = parts + static_cast<uint64_t>(blockIdx.x) * num_parts * kPoseValues;
    double sum = 0;
    for (uint32_t p = threadIdx.x % 32; p < num_parts; p += 32)
        sum += of_view[static_cast<uint64_t>(p) * kPoseValues + value];
    sum = warp_sum(sum);
    if (threadIdx.x % 32 == 0) reinterpret_cast<double*>(&sums)[value] = sum;
    __syncthreads();
    if (threadIdx.x != 0) return;
    double d_pose[12];
    pose_gradient(sums, placements[blockIdx.x].view, d_pose);
    for (int k = 0; k < 12; ++k) poses[12 * blockIdx.x + k] = static_cast<float>(d_pose[k]);
}

template <int kDegree>
void start(const ProjectViewsInput& in, const GradientSlots& slots, const ViewsGradients& out,
           bool adds, float* pose_parts, cudaStream_t stream) {
    const auto kernel = out.poses != nullptr ? &project_views_backward_kernel<kDegree, true>
                                             : &project_views_backward_kernel<kDegree, false>;
    launch("project_views_backward_kernel", kernel, blocks_for(in.num_gaussians, kItemSize),
           kThreads, kThreads * SumRow<kDegree>::kStride * sizeof(float), stream, in, slots, out,
           adds, pose_parts);
}

void start_of_degree(const ProjectViewsInput& in, const GradientSlots& slots,
                     const ViewsGradients& out, bool adds, float* pose_parts, cudaStream_t stream) {
    switch (in.sh_degree) {
        case kPlainColor: return start<kPlainColor>(in, slots, out, adds, pose_parts, stream);
        case 0: return start<0>(in, slots, out, adds, pose_parts, stream);
        case 1: return start<1>(in, slots, out, adds, pose_parts, stream);
        case 2: return start<2>(in, slots, out, adds, pose_parts, stream);
        default: return start<3>(in, slots, out, adds, pose_parts, stream);
    }
}

template <class Value>
void clear(Value* values, size_t size, cudaStream_t stream) {
    if (values == nullptr || size == 0) return;
    check(cudaMemsetAsync(values, 0, size * sizeof(Value), stream), "cudaMemsetAsync");
}

}  // namespace

ViewsGradients ViewsGradients::from(size_t view) const {
    ViewsGradients out = *this;
    const size_t skipped = view * rows.size;
    if (has_opacities_for_each_view) out.rows.opacities += skipped;
    if (has_sh_for_each_view) out.rows.sh += skipped * rows.num_sh();
    if (centers.sum != nullptr) out.centers.sum += 2 * skipped;
    if (centers.size != nullptr) out.centers.size += skipped;
    if (poses != nullptr) out.poses += 12 * view;
    return out;
}

void project_views_backward(const ProjectViewsInput& in, const GradientSlots& slots,
                            const ViewsGradients& out, bool adds, cudaStream_t stream) {
    const size_t num_items = blocks_for(in.num_gaussians, kItemSize);
    const size_t num_pairs = in.num_views * static_cast<size_t>(in.num_gaussians);
    const size_t num_values =
        out.poses == nullptr ? 0 : kPoseValues * num_items * static_cast<size_t>(in.num_views);
    const DeviceBuffer<float> pose_parts(num_values, stream);
    clear(pose_parts.data(), num_values, stream);
    clear(out.centers.sum, 2 * num_pairs, stream);
    clear(out.centers.size, num_pairs, stream);
    if (out.has_opacities_for_each_view) clear(out.rows.opacities, num_pairs, stream);
    if (out.has_sh_for_each_view) clear(out.rows.sh, out.rows.num_sh() * num_pairs, stream);
    start_of_degree(in, slots, out, adds, pose_parts.data(), stream);
    if (out.poses != nullptr)
        launch("poses_kernel", &poses_kernel, in.num_views, 32 * kPoseValues, 0, stream,
               pose_parts.data(), static_cast<uint32_t>(num_items), in.placements, out.poses);
}

}  // namespace cuda
}  // namespace v3dg

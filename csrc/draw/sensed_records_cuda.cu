// Finds the normal and the instance of each record of a frame. A warp processes an
// item, and a lane one record.

#include "base/launch.cuh"
#include "draw/sensed_records.h"
#include "project/sources.cuh"
#include "rasterize/sense_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kRecordThreads = 128;
constexpr unsigned kRecordBlocks = 16;  // resident blocks per multiprocessor

// The gaussian and the placement of a record.
struct RecordSource {
    uint32_t gaussian, placement;
};

__device__ RecordSource source_of(const DrawItem& item, uint32_t source) {
    if (item.sharers == 0) return {.gaussian = source, .placement = item.placement};
    return {.gaussian = item.first + source / 32, .placement = item.placement + source % 32};
}

__device__ int32_t instance_of(const SensedRecordsInput& in, uint32_t placement) {
    const auto slot = static_cast<int32_t>(placement % in.scene.num_slots);
    if (in.scene.cameras == nullptr) return slot;
    const BatchCamera& camera = in.scene.cameras[placement / in.scene.num_slots];
    return in.environments.instance_of(camera.environment, slot);
}

__device__ void normal_of_coded(const CodedGaussians& model, const DrawItem& item, uint32_t g,
                                const ModelView<float>& view, float normal[3]) {
    CodeSource::Place place{.cluster = item.cluster,
                            .end = static_cast<uint32_t>(model.codes.offset[item.cluster + 1])};
    CodeSource::advance(model, place, g);
    float color[3], p[3];
    const Gaussian3d<float> gaussian =
        CodeSource::decoded(model, place.cluster, CodeSource::fetch(model, g), color);
    to_view(view, gaussian.mean, p);
    normal_of_gaussian(gaussian.quat, gaussian.scale, view, p, normal);
}

__device__ void normal_of_row(const GaussianRows<const float>& rows, uint32_t g,
                              const ModelView<float>& view, float normal[3]) {
    float p[3];
    to_view(view, rows.means + 3 * size_t(g), p);
    normal_of_gaussian(rows.quats + 4 * size_t(g), rows.scales + 3 * size_t(g), view, p, normal);
}

__device__ void normal_of_packed(const PackedPlanes& planes, uint32_t g,
                                 const ModelView<float>& view, float normal[3]) {
    const float4 sphere = load4(planes.plane[0], g), a = load4(planes.plane[1], g),
                 b = load4(planes.plane[2], g);
    const float mean[3] = {sphere.x, sphere.y, sphere.z};
    const float f[8] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w};
    float p[3];
    to_view(view, mean, p);
    normal_of_factor(f, view, p, normal);
}

__device__ void normal_of(const SensedRecordsInput& in, const DrawItem& item,
                          const RecordSource& source, float normal[3]) {
    const Placement& placement = in.placements[source.placement];
    const uint32_t model = placement.model, g = source.gaussian;
    if (in.coded != nullptr && CodeSource::has(in.coded[model]))
        normal_of_coded(in.coded[model], item, g, placement.view, normal);
    else if (in.models != nullptr && in.models[model].quats != nullptr)
        normal_of_row(in.models[model], g, placement.view, normal);
    else
        normal_of_packed(in.packed[model], g, placement.view, normal);
}

__global__ void __launch_bounds__(kRecordThreads)
    sensed_records_kernel(SensedRecordsInput in, float* normal, int32_t* instance) {
    await_kernel_before();
    if (!in.items.is_complete()) return;
    const auto num_items = static_cast<uint32_t>(in.items.counters->items);
    constexpr uint32_t kRecordWarps = kRecordThreads / 32;
    for (uint32_t i = blockIdx.x * kRecordWarps + threadIdx.x / 32; i < num_items;
         i += gridDim.x * kRecordWarps) {
        const DrawItem& item = in.items.items[i];
        const uint32_t end = item.record + in.item_records[i];
        for (uint32_t record = item.record + threadIdx.x % 32; record < end; record += 32) {
            const RecordSource source = source_of(item, in.source[record]);
            if (normal != nullptr) normal_of(in, item, source, normal + 3 * size_t(record));
            if (instance != nullptr) instance[record] = instance_of(in, source.placement);
        }
    }
}

}  // namespace

void find_sensed_records(const SensedRecordsInput& in, float* normal, int32_t* instance,
                         cudaStream_t stream) {
    launch_early("sensed_records_kernel", sensed_records_kernel,
                 kRecordBlocks * num_multiprocessors(), kRecordThreads, 0, stream, in, normal,
                 instance);
}

}  // namespace cuda
}  // namespace v3dg

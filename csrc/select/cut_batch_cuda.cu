// Computes the cut of a batch. The cut of each camera equals the one that cut_cuda.cu
// computes for that camera alone. The number of kernels is the same as for a single
// camera.
//
// place_batch_kernel has a thread for each slot of each camera, and each block belongs
// to one camera. Slots are aligned to blocks. Therefore a warp has the same instances
// as in the cut of a single camera, and the same adjacent instances share items.
// cut_kernel then tests the parts of all cameras.

#include <algorithm>

#include "base/device_guard.h"
#include "select/cut_kernel.cuh"
#include "select/draw_items.cuh"
#include "select/place_instances.cuh"
#include "select/read_cameras.cuh"

namespace v3dg {
namespace cuda {

namespace {

// Returns the image of camera b.
__device__ FrameImage image_of(const BatchViews& views, const Camera& camera, uint32_t b) {
    FrameImage image = views.first;
    const BatchPlanes planes = views.planes.from(size_t(b) * image.width * image.height);
    image.camera = camera.intrinsics<float>();
    image.first_tile = b * num_tiles_of(image);
    image.planes = {.color = planes.color,
                    .alpha = planes.alpha,
                    .depth = planes.depth,
                    .has_four_channels = planes.channels == 4};
    return image;
}

// Launched with one thread per place. Each thread computes the sides of the frustum
// itself, because a table for all cameras and bundles could be larger than the
// instances.
__global__ void __launch_bounds__(kPlaceThreads, kPlaceBlocks / 2)
    place_batch_kernel(PlacedScene scene, EnvironmentTable environments, BatchViews views,
                       SelectRule rule, BatchPlacements out, int32_t* bundle_of_place,
                       CutScratch scratch) {
    __shared__ BatchCamera own;
    const size_t block = take_ticket(scratch.place_ticket);
    const unsigned blocks_each = views.num_slots / kPlaceThreads;
    const uint32_t b = static_cast<uint32_t>(block / blocks_each);
    const int32_t s = static_cast<int32_t>(block % blocks_each * kPlaceThreads + threadIdx.x);
    const bool reads_copies = views.source == CameraSource::copies;
    if (threadIdx.x == 0)
        own = reads_copies ? views.cameras[b]
                           : read_camera(views.arrays, environments, views.first_camera + b);
    if (s == 0) {
        if (!reads_copies) views.cameras[b] = own;
        out.images[b] = image_of(views, own.camera, b);
        views.counts[b] = {};
    }
    __syncthreads();
    const int32_t num_instances = own.is_drawn != 0 ? environments.num_slots(own.environment) : 0;
    InstanceSlot slot{.is_taken = s < num_instances,
                      .instance = 0,
                      .place = block * kPlaceThreads + threadIdx.x,
                      .image = b};
    if (slot.is_taken) {
        slot.instance = static_cast<size_t>(environments.instance_of(own.environment, s));
        bundle_of_place[slot.place] = scene.instances.bundle[slot.instance];
        if (out.factors != nullptr)
            out.factors[slot.place] = scene.instances.factors[slot.instance];
    }
    const Eyes eyes(own.camera);
    const auto sides_of = [&](int32_t bundle) {
        return sides_of_eyes(eyes, scene.bundles[bundle].table.pad_px);
    };
    const Placed placed = place_instance(scene, slot, eyes, sides_of, rule, out.placements);
    const unsigned num_parts =
        write_parts(scene, placed, block, slot.place, static_cast<size_t>(num_instances), scratch);
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = num_parts;
}

}  // namespace

size_t batch_slots(size_t most_instances) {
    return kPlaceThreads * size_t(place_blocks(most_instances));
}

size_t Cut::num_batch_zeros(size_t num_places) { return zeros_of_round(num_places); }

void Cut::cut_batch(const SceneTables& scene, const BatchViews& views, const SelectRule& rule,
                    const BatchPlacements& out, const ItemList& items, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    const size_t count = views.num_places();
    const size_t parts = std::max<size_t>(views.num_cameras * views.most_parts, 1);
    const unsigned num_places = kCutBlocks * num_multiprocessors();
    const size_t num_tickets = std::max<size_t>(blocks_for(parts, kCutWarps), num_places);
    Count* states = states_.reserve(2 * num_tickets, stream);
    const CutScratch scratch = scratch_in(items.zeros, states, num_tickets, num_places);
    const SceneOnDevice on_device = scene.on_device();
    int32_t* bundle_of_place = bundle_of_place_.reserve(count, stream);
    const PlacedScene placed{.bundles = on_device.bundles,
                             .instances = on_device.instances,
                             .bundle_of_place = bundle_of_place,
                             .views = views_.reserve(count, stream),
                             .tops = tops_.reserve(count, stream),
                             .parts = parts_.reserve(parts, stream)};
    launch("place_batch_kernel", place_batch_kernel, blocks_for(count, kPlaceThreads),
           kPlaceThreads, 0, stream, placed, on_device.environments, views, rule, out,
           bundle_of_place, scratch);
    const auto blocks = static_cast<unsigned>(std::min<size_t>(parts, 2 * num_places));
    const auto cut_into = [&](const auto& output) {
        using Output = std::decay_t<decltype(output)>;
        launch_early("cut_kernel", cut_kernel<Output, false>, blocks, kCutThreads, 0, stream,
                     placed, rule, nullptr, nullptr, scratch, scratch, NeedList{}, output);
    };
    if (rule.fade.is_on())
        cut_into(ItemOutput<true>{.items = items, .num_pictures = 1, .num_placements = 0});
    else
        cut_into(ItemOutput<false>{.items = items, .num_pictures = 1, .num_placements = 0});
}

}  // namespace cuda
}  // namespace v3dg

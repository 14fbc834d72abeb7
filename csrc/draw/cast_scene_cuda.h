#pragma once

// Casts the rays of a spherical sensor on a CUDA device, at many poses.

#include <vector>

#include "draw/cast_scene.h"
#include "draw/scene_frame_cuda.h"
#include "rays/rays_cuda.h"

namespace v3dg {
namespace cuda {

// Poses on the device: (B, 4, 4) transforms from the world to the sensor, and the
// environments that it sees there. If a pose is not a rigid motion, or the scene does
// not have its environment, its rays hit nothing.
struct RayPoses {
    const void* viewmats;
    bool are_double;
    const void* environments;  // (B,); null if the sensors see all instances
    bool are_environments_long;
    uint32_t count;
};

// The directions of a sensor's rays, in device memory.
class DeviceRayGrid {
  public:
    // Copies the directions to the device if they are not there yet.
    const RayDirections& load(const std::shared_ptr<const RayGrid>& grid, cudaStream_t stream);

  private:
    std::shared_ptr<const RayGrid> grid_;
    DeviceBuffer<float> floats_;
    DeviceBuffer<int32_t> ints_;
    RayDirections directions_{};
};

// Casts rays through scenes that share their bundles, or through assets. The buffers
// are reused from cast to cast. Poses are cast in parts whose gaussians fit into
// bounded memory. Each part waits for the device once, to read its numbers of records
// and entries. The rest of its work may still be in progress when a cast returns.
class RayFrame {
  public:
    // Sets the gaussians of each bundle of the scene.
    void set_models(std::vector<DeviceModel> models, cudaStream_t stream);

    // Casts all rays through the cut of a scene at each pose. The cuts have no frustum,
    // and `rule` must not have a budget. The results of the poses follow one another in
    // the planes. Returns the number of selected gaussians at each pose. Throws
    // OutOfMemory, or std::length_error if one pose has too many rays or entries.
    std::vector<int64_t> cast_scene(const SceneTables& scene, const RaySensor& sensor,
                                    const RayPoses& poses, SelectRule rule, const RayPlanes& planes,
                                    cudaStream_t stream);

    // Casts all rays through all gaussians of one asset.
    std::vector<int64_t> cast_model(const GaussianRows<const float>& rows,
                                    const Appearance<float>& appearance, const RaySensor& sensor,
                                    const RayPoses& poses, const RayPlanes& planes,
                                    cudaStream_t stream);

  private:
    struct Subject;
    struct Counts;
    std::vector<int64_t> cast(const Subject& subject, const RaySensor& sensor,
                              const RayPoses& poses, const RayPlanes& planes, cudaStream_t stream);
    // Casts poses [first, first + count), and returns their numbers of gaussians.
    std::vector<int64_t> cast_part(const Subject& subject, const RaySensor& sensor,
                                   const CameraArrays& poses, uint32_t first, uint32_t count,
                                   const RayPlanes& planes, cudaStream_t stream);
    // Enqueues the cut and the projection.
    RayLists project(const Subject& subject, const RaySensor& sensor, const BatchViews& views,
                     const RayDirections& rays, unsigned char* cleared, cudaStream_t stream);
    RayInput write_items(const Subject& subject, const BatchViews& views, const ItemList& items,
                         cudaStream_t stream);
    void release_buffers();

    std::vector<DeviceModel> models_;
    DeviceBuffer<GaussianRows<const float>> rows_, asset_;
    DeviceBuffer<CodedGaussians> coded_;
    bool has_rows_ = false, has_coded_ = false;
    Cut cut_;
    DeviceRayGrid grid_;
    DeviceBuffer<double> intrinsics_;
    DeviceBuffer<BatchCamera> cameras_;
    DeviceBuffer<FrameImage> images_;
    DeviceBuffer<Placement> placements_;
    DeviceBuffer<InstanceFactors> factors_;
    DeviceBuffer<unsigned char> counters_;
    DeviceBuffer<DrawItem> items_;
    DeviceBuffer<RayRecord> records_;
    DeviceBuffer<uint64_t> entries_;
    RaySortBuffers sorted_;
    size_t item_capacity_ = 1 << 12, record_capacity_ = 1 << 16, entry_capacity_ = 1 << 17;
    uint32_t most_poses_ = 1;  // maximum number of poses in the next part
    StreamMutex busy_;
};

}  // namespace cuda
}  // namespace v3dg

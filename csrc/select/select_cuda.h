#pragma once

#include <vector>

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/image.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

// How the clusters of one bundle are drawn.
struct ClusterFilters {
    Span<const float> filter_px2;    // [C]
    Span<const uint8_t> compensate;  // [C]
};

struct ClusterBounds;

// A bundle's tables on the device.
struct DeviceBundle {
    ClusterTable table;
    ClusterFilters filters;
    const ClusterBounds* bounds;  // of a few clusters each
};

struct PoseSpan {
    Span<const double> values;
    bool is_on_device;
};

struct CutPart;
struct BudgetState;

// A scene's instances and the tables of its bundles, resident on the device, and the cut of one view.
// Everything is enqueued on the stream that is passed. Several threads and streams take turns.
class SceneTables {
  public:
    // Host memory may be reused on return.
    SceneTables(Span<const ClusterTable> tables, Span<const ClusterFilters> filters, cudaStream_t stream);

    // Takes the place of all instances; poses come next.
    void set_instances(Span<const int32_t> bundle, Span<const float> importance, cudaStream_t stream);
    // Each of the three is either the host's, which may be reused on return, or the device's, which stays.
    void set_poses(const PoseSpan& position, const PoseSpan& quaternion, const PoseSpan& scale,
                   cudaStream_t stream);

    size_t num_instances() const { return num_instances_; }

    // Selected clusters as the items of a frame. Instance i becomes placement i of model bundle[i] in image
    // 0, and `image` is written to images[0].
    void cut_items(const Camera& camera, const SelectRule& rule, const FrameImage& image, FrameImage* images,
                   Placement* placements, const ItemList& items, cudaStream_t stream);

    // The same for pairs that were selected before, on the device.
    void given_items(const Camera& camera, Span<const int32_t> instance, Span<const int32_t> cluster,
                     const FrameImage& image, FrameImage* images, Placement* placements,
                     const ItemList& items, cudaStream_t stream);

    // Selected clusters as pairs, on the host, after waiting.
    void select(const Camera& camera, const SelectRule& rule, SelectOutput& out, cudaStream_t stream);

  private:
    struct Pairs {
        unsigned long long pairs, gaussians;
        CutChoice choice;
    };
    template <class Output>
    void cut(const Camera& camera, const SelectRule& rule, const FrameImage* image, FrameImage* images,
             Placement* placements, CutChoice* choice, const Output& output, cudaStream_t stream);
    InstanceTable instances() const;

    Turns turns_;
    size_t num_instances_ = 0, most_parts_ = 0;
    std::vector<size_t> num_clusters_;                  // of each bundle
    std::vector<DeviceBuffer<unsigned char>> storage_;  // what the spans of the tables point into
    DeviceBuffer<DeviceBundle> bundles_;
    DeviceBuffer<int32_t> bundle_;
    DeviceBuffer<float> importance_;
    DeviceBuffer<double> uploaded_[3];
    const double *position_ = nullptr, *quaternion_ = nullptr, *scale_ = nullptr;
    DeviceBuffer<InstanceView> views_;
    DeviceBuffer<uint8_t> tops_;
    DeviceBuffer<CutPart> parts_;
    DeviceBuffer<unsigned long long> scratch_, change_;
    DeviceBuffer<BudgetState> budget_;
    DeviceBuffer<int32_t> pair_instance_, pair_cluster_;
    DeviceBuffer<Pairs> pairs_;
};

}  // namespace cuda
}  // namespace v3dg

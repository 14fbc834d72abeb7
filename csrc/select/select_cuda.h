#pragma once

#include <vector>

#include "base/device.h"
#include "pipeline/frame_types.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

// How the clusters of one bundle are drawn.
struct ClusterFilters {
    Span<const float> filter_px2;    // [C]
    Span<const uint8_t> compensate;  // [C]
};

// A bundle's tables on the device.
struct DeviceBundle {
    ClusterTable table;
    ClusterFilters filters;  // empty when only the cut is wanted
};

struct InstanceCut;
struct CutScratch;

// A scene's instances and the tables of its bundles, resident on the device, and the cut of one view.
// Everything is enqueued on the stream that is passed; whoever uses several orders them.
class SceneTables {
  public:
    // `filters` may be empty when only the cut is wanted. Host memory may be reused on return.
    SceneTables(Span<const ClusterTable> tables, Span<const ClusterFilters> filters,
                const InstanceTable& instances, cudaStream_t stream);

    size_t num_instances() const { return num_instances_; }

    // Selected clusters as the items of a frame, clusters that are neighbours in an asset together.
    // Instance i becomes placement i of model bundle[i] in image 0, and `image` is written to images[0].
    void cut_items(const SelectCamera& camera, const SelectRule& rule, const FrameImage& image,
                   FrameImage* images, Placement* placements, const ItemList& items, cudaStream_t stream);

    // Selected clusters as pairs. Returns how many there are and how many gaussians they have, after waiting;
    // pairs past `capacity` are not written.
    struct Counts {
        unsigned long long pairs, gaussians;
    };
    Counts cut_pairs(const SelectCamera& camera, const SelectRule& rule, int32_t* instance, int32_t* cluster,
                     unsigned long long capacity, cudaStream_t stream);

  private:
    template <class Output>
    void cut(const SelectCamera& camera, const SelectRule& rule, const FrameImage* image, FrameImage* images,
             Placement* placements, const Output& output, cudaStream_t stream);

    size_t num_instances_, most_parts_ = 0;
    std::vector<DeviceBuffer<unsigned char>> storage_;  // what the spans of the tables point into
    DeviceBuffer<DeviceBundle> bundles_;
    DeviceBuffer<int32_t> bundle_;
    DeviceBuffer<double> position_, rotation_, scale_;
    DeviceBuffer<InstanceCut> cuts_;
    DeviceBuffer<unsigned long long> scratch_;
};

}  // namespace cuda
}  // namespace v3dg

#pragma once

// The cuts of several windows at once, on CUDA, as the items of one frame.

#include "draw/frame_cuda.h"
#include "levels/cut_views.h"
#include "levels/refine_cuts.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {
namespace cuda {

// The tables of a bundle that a cut reads, on the device.
class DeviceTable {
  public:
    // The host's arrays may be reused on return.
    DeviceTable(const ClusterTable& table, cudaStream_t stream);
    const ClusterTable& table() const { return table_; }

  private:
    DeviceBuffer<unsigned char> storage_;  // memory of all arrays
    ClusterTable table_;
};

// The clusters that windows show.
enum class Shown {
    cuts,    // those of the windows' cuts
    leaves,  // those of level 0
};

// Windows as kernels read them, in one block of memory.
struct WindowTables {
    uint32_t count;
    InstanceView view[kMostWindows];
    SelectRule rule[kMostWindows];
    Placement placement[kMostWindows];
    FrameImage image[kMostWindows];
    ReadPlanes target[kMostWindows];
    PictureGradient<float> slope[kMostWindows];
};

// Returns the colour and alpha planes of one window. `memory` has room for
// `most_pixels` pixels of each window, four floats each.
V3DG_HD inline PicturePlanes planes_of_window(float* memory, size_t most_pixels, size_t window) {
    float* color = memory + 4 * most_pixels * window;
    return {color, color + 3 * most_pixels, nullptr, false};
}

// Windows on the device, and the items of their clusters. A cluster of C has as many
// items as it has begun kItemSize gaussians.
class DeviceWindows {
  public:
    // Uploads the tables and cuts all windows; the host's memory may be reused on
    // return.
    void cut(const DeviceTable& table, const WindowTables& windows, Shown shown,
             cudaStream_t stream);

    uint32_t count() const { return count_; }
    uint32_t num_tiles() const { return num_tiles_; }
    const WindowTables* tables() const { return tables_.data(); }
    // [count * C] the first item of a cluster among those of its window; -1: it is not
    // shown.
    const int32_t* item_of_cluster() const { return item_of_cluster_.data(); }
    const uint32_t* num_items() const { return num_items_.data(); }  // [count]

    // Enqueues the items of a frame of all windows, window by window. Item i has the
    // records from kItemSize * i on.
    void write_items(const DeviceTable& table, const Appearance<float>& appearance,
                     const ItemList& items, cudaStream_t stream) const;

  private:
    uint32_t count_ = 0;
    uint32_t num_tiles_ = 0;
    DeviceBuffer<WindowTables> tables_;
    DeviceBuffer<int32_t> item_of_cluster_;
    DeviceBuffer<uint32_t> num_items_;
};

}  // namespace cuda
}  // namespace v3dg

#pragma once

// Computes the cuts of several windows at once, on CUDA. Their clusters become the
// items of one frame.

#include "draw/frame_cuda.h"
#include "levels/cut_views.h"
#include "levels/refine_cuts.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {
namespace cuda {

// The tables of a bundle that a cut reads, in device memory.
class DeviceTable {
  public:
    // Copies the table before it returns.
    DeviceTable(const ClusterTable& table, cudaStream_t stream);
    const ClusterTable& table() const { return table_; }

  private:
    DeviceBuffer<unsigned char> storage_;  // memory of all arrays
    ClusterTable table_;
};

// Which clusters the windows show.
enum class Shown {
    cuts,    // the clusters of the windows' cuts
    leaves,  // the clusters of level 0
};

// The data of windows that kernels read, in one block of memory.
struct WindowTables {
    uint32_t count;
    InstanceView view[kMostWindows];
    SelectRule rule[kMostWindows];
    Placement placement[kMostWindows];
    FrameImage image[kMostWindows];
    ReadPlanes target[kMostWindows];
    PictureGradient<float> slope[kMostWindows];
};

// Returns the colour and alpha planes of a window. `memory` must have room for
// `most_pixels` pixels per window, with four floats each.
V3DG_HD inline PicturePlanes planes_of_window(float* memory, size_t most_pixels, size_t window) {
    float* color = memory + 4 * most_pixels * window;
    return {color, color + 3 * most_pixels, nullptr, false};
}

// Windows on the device, and the items of their clusters. A cluster with n gaussians
// has n / kItemSize items, rounded up. C is the number of clusters.
class DeviceWindows {
  public:
    // Computes the cuts of all windows on the device. Copies the tables before it
    // returns.
    void cut(const DeviceTable& table, const WindowTables& windows, Shown shown,
             cudaStream_t stream);

    uint32_t count() const { return count_; }
    uint32_t num_tiles() const { return num_tiles_; }
    const WindowTables* tables() const { return tables_.data(); }
    // [count * C] for each window and cluster, the index of the cluster's first item
    // within the window; -1 if the window does not show the cluster
    const int32_t* item_of_cluster() const { return item_of_cluster_.data(); }
    // [count] number of items of each window
    const uint32_t* num_items() const { return num_items_.data(); }

    // Enqueues a kernel that writes the items of all windows to `items`: those of the
    // first window, then those of the second, and so on. The records of item i of the
    // whole list begin at kItemSize * i.
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

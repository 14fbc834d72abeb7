#pragma once

// The cameras of a batch, and a batch of pictures that has been drawn.

#include <memory>
#include <optional>
#include <vector>

#include "bindings/array.h"
#include "bindings/drawing.h"
#include "bindings/sensor.h"
#include "bindings/types.h"
#include "frame/image.h"
#include "residency/environments.h"

namespace v3dg {

// A borrowed array of float32 or float64.
struct Reals {
    const void* data;
    bool are_double;
};

// Borrows an array of float64 or, on a device, of float32.
Reals reals_of(Device device, const py::object& array, const char* name, const Shape& shape);

// A borrowed array of int32 or int64; null where it is missing.
struct Wholes {
    const void* data;
    bool are_long;
};

// Borrows an array of int32 or, on a device, of int64, or None.
Wholes wholes_of(Device device, const py::object& array, const char* name, const Shape& shape);

// Throws ValueError if a camera or a sensor has an environment that the scene does not
// have. Does nothing for arrays on a device.
void check_environments(Device device, const Wholes& environments, size_t count,
                        const EnvironmentTable& table, const char* name);

// B cameras of one size. The arrays are on the host or on one device. They are read
// when a batch is drawn, so they may change in place between batches.
class BoundCameras {
  public:
    // viewmats: (B, 4, 4) world to camera. K: (B, 3, 3), or (3, 3) for all cameras.
    // environments: (B,) int32 or int64, or None for cameras that see all instances.
    // Arrays on the host are float64 and int32, and are checked. lenses: the B cameras
    // themselves, if some have lens distortion, on the host only; or None.
    BoundCameras(py::object viewmats, py::object K, int width, int height, double near,
                 py::object environments, const std::optional<std::vector<BoundCamera>>& lenses);

    Device device() const { return device_; }
    size_t size() const { return size_; }
    int width() const { return width_; }
    int height() const { return height_; }
    double near_depth() const { return near_depth_; }
    const Reals& viewmats() const { return viewmats_; }
    const Reals& intrinsics() const { return intrinsics_; }
    bool shares_intrinsics() const { return shares_intrinsics_; }
    // Null if the cameras see all instances.
    const Wholes& environments() const { return environments_; }
    // The cameras if some have lens distortion; otherwise empty.
    const std::vector<Camera>& lenses() const { return lenses_; }
    // Returns the cameras. Their arrays must be on the host.
    std::vector<Camera> on_host() const;

  private:
    py::object viewmats_object_, intrinsics_object_, environments_object_;
    Device device_;
    size_t size_ = 0;
    int width_, height_;
    double near_depth_;
    Reals viewmats_{}, intrinsics_{};
    bool shares_intrinsics_ = false;
    Wholes environments_{};
    std::vector<Camera> lenses_;
};

// The planes of a batch: arrays that belong to the caller, or new ones.
class BoundPlanes {
  public:
    // color: (B, H, W, 3 or 4). alpha, depth: (B, H, W), or None. With four channels,
    // alpha must be None. channels: (B, H, W), normals (B, H, W, 3), or None; without
    // `clipped`.
    BoundPlanes(py::object color, py::object alpha, py::object depth, NewChannels channels);
    // Makes arrays of colour with three channels, of alpha and, if requested, of depth.
    BoundPlanes(const BoundCameras& cameras, Device device, bool with_depth);

    const py::object& color() const { return color_; }
    const py::object& alpha() const { return alpha_; }
    const py::object& depth() const { return depth_; }
    const BatchPlanes& planes() const { return planes_; }
    const NewChannels& channels() const { return channels_; }
    const SensorPlanes& sensor_planes() const { return sensor_planes_; }
    // Throws ValueError unless the planes fit these cameras and are on this device.
    void check(const BoundCameras& cameras, Device device) const;

  private:
    py::object color_, alpha_, depth_;
    NewChannels channels_;
    Device device_;
    py::ssize_t count_, height_, width_;
    BatchPlanes planes_{};
    SensorPlanes sensor_planes_{};
};

// The statistics of each picture of a batch.
struct BatchStats {
    std::vector<int64_t> gaussians, in_frustum;
    // On a device, the first element is for the whole batch.
    std::vector<double> select_ms, draw_ms;
    // On the host: selected gaussians of each level.
    std::vector<std::vector<int64_t>> levels;
    int num_parts = 1;  // number of parts in which the batch was drawn
};

// A batch that was drawn, or that was enqueued on a device.
class BoundBatch {
  public:
    BoundBatch() = default;
    virtual ~BoundBatch() = default;
    BoundBatch(const BoundBatch&) = delete;
    BoundBatch& operator=(const BoundBatch&) = delete;

    // Waits until the pictures are drawn.
    virtual void finish() {}
    // Waits until the pictures are drawn, and returns their statistics.
    virtual BatchStats stats() = 0;
    // Keeps the inputs and the planes alive as long as this object.
    void keep(py::object kept, const BoundPlanes& planes) {
        kept_ = std::move(kept);
        color = planes.color();
        alpha = planes.alpha();
        depth = planes.depth();
    }

    py::object color, alpha, depth;  // as in BoundPlanes
    NewChannels channels;

  private:
    py::object kept_;  // destroyed after the members of a derived class
};

}  // namespace v3dg

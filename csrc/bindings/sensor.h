#pragma once

// Channels of pictures beside colour, and layers of meshes, for Python.

#include <optional>
#include <string>
#include <vector>

#include "bindings/array.h"
#include "frame/sensor.h"

namespace v3dg {

// New planes for channels. A channel that is not requested is None.
struct NewChannels {
    py::object median_depth = py::none(), normal = py::none(), instance = py::none(),
               label = py::none(), weight = py::none(), clipped = py::none();

    // Allocates the arrays of channels that have none in `planes`, and returns the
    // planes of all channels. `shape` is that of a plane: (H, W) or (B, H, W).
    SensorPlanes allocate(Device device, const Channels& channels,
                          const std::vector<py::ssize_t>& shape, SensorPlanes planes = {});
};

// A layer of meshes: borrowed arrays of one picture (H, W) or of many (B, H, W).
class BoundMesh {
  public:
    // color: (..., 3). depth, coverage: (...). normal: (..., 3) or None. instance,
    // label: (...) int32 or None. On a CUDA device, coverage may be None: 1 where the
    // depth is positive and finite.
    BoundMesh(py::object color, py::object depth, py::object coverage, py::object normal,
              py::object instance, py::object label, bool is_linear);

    Device device() const { return device_; }
    const MeshLayer& layer() const { return layer_; }
    // Returns the layer of one of two eyes. Throws ValueError unless the shape is
    // (2, H, W).
    BoundMesh of_eye(int number) const;
    // Throws ValueError unless a plane has this shape.
    void check(const std::vector<py::ssize_t>& shape) const;

  private:
    std::vector<py::object> arrays_;
    std::vector<py::ssize_t> shape_;
    Device device_;
    MeshLayer layer_;
};

// The channels and the meshes of a request.
class BoundSensor {
  public:
    // `mesh` is a BoundMesh or None.
    BoundSensor(const std::vector<std::string>& channels, py::object mesh);

    const Channels& channels() const { return channels_; }
    // Returns the sensor with the meshes of one of two eyes.
    BoundSensor of_eye(int number) const;
    // Returns the request for planes of this shape. Throws ValueError if the mesh has
    // another shape.
    SensorRequest request(const std::vector<py::ssize_t>& shape) const;
    // Throws ValueError if there is a mesh on another device.
    void check_device(Device device) const;

  private:
    Channels channels_;
    py::object mesh_;  // BoundMesh or None
};

}  // namespace v3dg

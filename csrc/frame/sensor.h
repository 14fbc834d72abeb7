#pragma once

// Channels of a picture other than colour, and the z-buffer of meshes that hide the
// gaussians behind them. docs/sensors.md defines every channel.

#include <cstddef>
#include <cstdint>

#include "base/host_device.h"

namespace v3dg {

// Special values of the channels of ids. Instances and labels are numbered from 0.
constexpr int32_t kNoInstance = -1, kMeshInstance = -2, kNoLabel = -1;

// Advances a plane with `width` numbers per pixel to `pixel`. A null pointer stays
// null.
template <class T>
V3DG_HD T* plane_from(T* plane, size_t width, size_t pixel) {
    return plane == nullptr ? nullptr : plane + width * pixel;
}

// The channels of a picture, in row-major order. A plane that is null is not computed.
struct SensorPlanes {
    // Depth of the gaussian at which the transmittance falls to one half, or 0 if it
    // stays larger.
    float* median_depth = nullptr;
    float* normal = nullptr;  // (H, W, 3) in view space, unit length or 0
    // The instance with the largest weight in a pixel, its label, and that weight.
    int32_t* instance = nullptr;
    int32_t* label = nullptr;
    float* weight = nullptr;
    // 1 where a gaussian is missing because its centre is in front of the near plane.
    uint8_t* clipped = nullptr;

    V3DG_HD bool wants_ids() const { return instance != nullptr || label != nullptr; }
    V3DG_HD bool wants_strongest() const { return wants_ids() || weight != nullptr; }
    // Returns whether any channel requires the sensor pass.
    V3DG_HD bool wants_walk() const {
        return median_depth != nullptr || normal != nullptr || wants_strongest();
    }
    // Returns the planes with their pointers advanced to `pixel`.
    V3DG_HD SensorPlanes from(size_t pixel) const {
        return {.median_depth = plane_from(median_depth, 1, pixel),
                .normal = plane_from(normal, 3, pixel),
                .instance = plane_from(instance, 1, pixel),
                .label = plane_from(label, 1, pixel),
                .weight = plane_from(weight, 1, pixel),
                .clipped = plane_from(clipped, 1, pixel)};
    }
};

// The light in which colours of meshes are stored and mixed with those of gaussians.
enum class MeshLight { display, linear };

// The z-buffer of a picture of meshes, in row-major order.
struct MeshLayer {
    const float* color = nullptr;       // (H, W, 3) straight, not premultiplied
    const float* depth = nullptr;       // (H, W) in the unit of the gaussians' depths
    const float* coverage = nullptr;    // (H, W) from 0 to 1
    const float* normal = nullptr;      // (H, W, 3) in view space; null if unknown
    const int32_t* instance = nullptr;  // (H, W); null means kMeshInstance
    const int32_t* label = nullptr;     // (H, W); null means kNoLabel
    MeshLight light = MeshLight::display;

    V3DG_HD bool is_there() const { return depth != nullptr; }
    // Returns the layer with its pointers advanced to `pixel`.
    V3DG_HD MeshLayer from(size_t pixel) const {
        return {.color = plane_from(color, 3, pixel),
                .depth = plane_from(depth, 1, pixel),
                .coverage = plane_from(coverage, 1, pixel),
                .normal = plane_from(normal, 3, pixel),
                .instance = plane_from(instance, 1, pixel),
                .label = plane_from(label, 1, pixel),
                .light = light};
    }
};

// The channels of one picture, and its meshes.
struct Sensor {
    SensorPlanes planes;
    MeshLayer mesh;

    V3DG_HD bool is_on() const {
        return planes.wants_walk() || planes.clipped != nullptr || mesh.is_there();
    }
    V3DG_HD Sensor from(size_t pixel) const { return {planes.from(pixel), mesh.from(pixel)}; }
};

// The requested channels.
struct Channels {
    bool median_depth = false, normal = false, instance = false, label = false, weight = false,
         clipped = false;

    bool any() const { return median_depth || normal || instance || label || weight || clipped; }
};

// The request for channels, and the meshes among the gaussians.
struct SensorRequest {
    Channels channels;
    MeshLayer mesh;

    bool is_on() const { return channels.any() || mesh.is_there(); }
};

}  // namespace v3dg

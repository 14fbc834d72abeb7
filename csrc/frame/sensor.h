#pragma once

// Further channels of a picture beside colour, and the z-buffer of meshes that hide the
// gaussians behind them. docs/sensors.md defines every channel.

#include <cstddef>
#include <cstdint>

#include "base/host_device.h"

namespace v3dg {

// Values of the channels of ids. Instances and labels are numbered from 0.
constexpr int32_t kNoInstance = -1, kMeshInstance = -2, kNoLabel = -1;

// Returns a plane of `width` numbers per pixel from pixel `pixel` on; null stays null.
template <class T>
V3DG_HD T* plane_from(T* plane, size_t width, size_t pixel) {
    return plane == nullptr ? nullptr : plane + width * pixel;
}

// The channels of a picture, row major. Null planes are not computed.
struct SensorPlanes {
    // Depth of the gaussian behind which half of the light is gone; 0 if less is gone.
    float* median_depth = nullptr;
    float* normal = nullptr;  // (H, W, 3) in view space, unit length or 0
    // The instance with the largest weight in a pixel, its label, and that weight.
    int32_t* instance = nullptr;
    int32_t* label = nullptr;
    float* weight = nullptr;
    // 1 where a gaussian is missing because its centre is before the near plane.
    uint8_t* clipped = nullptr;

    V3DG_HD bool wants_ids() const { return instance != nullptr || label != nullptr; }
    V3DG_HD bool wants_strongest() const { return wants_ids() || weight != nullptr; }
    // Returns whether any channel is found by walking the list of a tile.
    V3DG_HD bool wants_walk() const {
        return median_depth != nullptr || normal != nullptr || wants_strongest();
    }
    // Returns the planes from pixel `pixel` on.
    V3DG_HD SensorPlanes from(size_t pixel) const {
        return {.median_depth = plane_from(median_depth, 1, pixel),
                .normal = plane_from(normal, 3, pixel),
                .instance = plane_from(instance, 1, pixel),
                .label = plane_from(label, 1, pixel),
                .weight = plane_from(weight, 1, pixel),
                .clipped = plane_from(clipped, 1, pixel)};
    }
};

// The light of the colours of meshes, in which they are mixed with those of gaussians.
enum class MeshLight { display, linear };

// The z-buffer of a picture of meshes, row major.
struct MeshLayer {
    const float* color = nullptr;       // (H, W, 3) straight, not premultiplied
    const float* depth = nullptr;       // (H, W) in the unit of the gaussians' depths
    const float* coverage = nullptr;    // (H, W) from 0 to 1
    const float* normal = nullptr;      // (H, W, 3) in view space; null: unknown
    const int32_t* instance = nullptr;  // (H, W); null: kMeshInstance
    const int32_t* label = nullptr;     // (H, W); null: kNoLabel
    MeshLight light = MeshLight::display;

    V3DG_HD bool is_there() const { return depth != nullptr; }
    // Returns the layer from pixel `pixel` on.
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

// The request for channels, and the meshes among which the gaussians are.
struct SensorRequest {
    Channels channels;
    MeshLayer mesh;

    bool is_on() const { return channels.any() || mesh.is_there(); }
};

}  // namespace v3dg

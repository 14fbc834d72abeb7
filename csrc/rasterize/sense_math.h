#pragma once

// Formulas of the sensor pass for one pixel or a vector of pixels: the sums from front
// to back, and the channels that are computed from them. Alpha and the stop rules are
// those of rasterize_math.h, so the weights equal those of the blended colour.
//
// A mesh at depth m divides the gaussians of a pixel into those in front (depth less
// than m) and those behind. A mesh with coverage c hides what is behind it in the
// fraction c of the pixel. So the pixel is c times the picture with a mesh that hides
// what is behind it, plus 1 - c times the picture without the mesh. Both have the same
// transmittances in front of the mesh.

#include "frame/image.h"
#include "frame/sensor.h"
#include "math/lanes.h"
#include "math/quat.h"
#include "math/vec.h"
#include "math/view.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {

// The median depth is where the transmittance falls to this value.
constexpr float kMedianTransmittance = 0.5f;

// Special values of a record index: the mesh, and nothing.
constexpr uint32_t kMeshRecord = ~0u;

// Returns the median depth of a pixel after a gaussian was blended. `before` is the
// median depth without this gaussian, or 0. `t` is the transmittance behind the
// gaussian; its sign tells whether the pixel has stopped, in which case no light
// passes. `passes` is the fraction of light that a mesh in front lets through, 1 if
// there is none.
template <class V>
V3DG_HD V3DG_INLINE V median_after(V before, V t, V passes, V depth) {
    const V left = max_of(t, V{}) * passes;
    const auto is_here = (before == V{}) & (left <= all_lanes<V>(Lane<V>(kMedianTransmittance)));
    return is_here ? depth : before;
}

// Sums over a pixel's gaussians in front of a mesh, or behind it.
struct SensedSums {
    float color[3], depth, normal[3];  // sums of weight times value
    float weight;                      // largest weight
    uint32_t record;                   // first record with this weight
};

// The mesh in a pixel.
struct SensedMesh {
    float coverage, depth;
    float passed;  // transmittance in front of the mesh; 0 if gaussians hide the mesh
};

// Factors that convert the sums to final weights.
struct SensedShares {
    float front, mesh, behind;
    float alpha;  // opacity of gaussians and meshes together
};

// Returns the factors of a blended pixel. If there is no mesh, or if it is hidden,
// `mesh.coverage` is 0 and all gaussians count as in front.
V3DG_HD V3DG_INLINE SensedShares shares_of(float t, float min_transmittance,
                                           const SensedMesh& mesh) {
    if (mesh.coverage >= 1) return {1, mesh.passed, 0, 1};
    const Finished<float> pixel = finished(t, min_transmittance);
    const float without = (1 - mesh.coverage) * pixel.gain;
    return {.front = without + mesh.coverage,
            .mesh = mesh.coverage * mesh.passed,
            .behind = without,
            .alpha = (1 - mesh.coverage) * (1 - pixel.transmittance) + mesh.coverage};
}

// What has the largest weight in a pixel: a record, the mesh, or nothing.
struct Strongest {
    float weight;
    uint32_t record;  // kMeshRecord with a positive weight: the mesh
};
V3DG_HD V3DG_INLINE Strongest strongest_of(const SensedSums& front, const SensedSums& behind,
                                           const SensedShares& share) {
    Strongest out{share.front * front.weight, front.record};
    if (share.mesh > out.weight) out = {share.mesh, kMeshRecord};
    const float weight = share.behind * behind.weight;
    if (weight > out.weight) out = {weight, behind.record};
    return out;
}

// Sets the blended normal of a pixel to a unit vector, or to 0 if there is none.
// `mesh_normal` may have any length; null means that it is unknown.
V3DG_HD V3DG_INLINE void blended_normal(const SensedSums& front, const SensedSums& behind,
                                        const float* mesh_normal, const SensedShares& share,
                                        float normal[3]) {
    for (int k = 0; k < 3; ++k)
        normal[k] = share.front * front.normal[k] + share.behind * behind.normal[k];
    const float mesh_length = mesh_normal == nullptr ? 0 : sqrt_of(dot3(mesh_normal, mesh_normal));
    if (share.mesh > 0 && mesh_length > 0)
        for (int k = 0; k < 3; ++k) normal[k] += share.mesh / mesh_length * mesh_normal[k];
    const float length = sqrt_of(dot3(normal, normal));
    for (int k = 0; k < 3; ++k) normal[k] = length > 0 ? normal[k] / length : 0.0f;
}

// Returns the expected depth of a pixel.
V3DG_HD V3DG_INLINE float blended_depth(const SensedSums& front, const SensedSums& behind,
                                        const SensedMesh& mesh, const SensedShares& share) {
    const float sum = share.front * front.depth + share.behind * behind.depth +
                      (share.mesh > 0 ? share.mesh * mesh.depth : 0.0f);
    return share.alpha > 0 ? sum / share.alpha : 0.0f;
}

// Convert between display light (sRGB, IEC 61966-2-1) and linear light. The curve is
// extended to values above 1, and mirrored for negative values.
V3DG_HD V3DG_INLINE float linear_of_display(float x) {
    const float a = abs_of(x);
    const float y = a <= 0.04045f ? a / 12.92f : powf((a + 0.055f) / 1.055f, 2.4f);
    return x < 0 ? -y : y;
}
V3DG_HD V3DG_INLINE float display_of_linear(float x) {
    const float a = abs_of(x);
    const float y = a <= 0.0031308f ? a * 12.92f : 1.055f * powf(a, 1 / 2.4f) - 0.055f;
    return x < 0 ? -y : y;
}

// Returns one channel of a pixel's colour, in display light. `without` is the colour
// without the mesh, and `front` the sum of the gaussians in front of it. `mesh_color`
// is in the space `light`, in which the colours are mixed.
V3DG_HD V3DG_INLINE float mixed_color(float without, float front, float mesh_color,
                                      const SensedMesh& mesh, MeshLight light) {
    const float c = mesh.coverage;
    if (c <= 0) return without;
    if (light == MeshLight::display) {
        const float with = front + mesh.passed * mesh_color;
        return c >= 1 ? with : (1 - c) * without + c * with;
    }
    const float opacity = 1 - mesh.passed;
    const float in_front = opacity > 0 ? opacity * linear_of_display(front / opacity) : 0.0f;
    const float with = in_front + mesh.passed * mesh_color;
    return display_of_linear(c >= 1 ? with : (1 - c) * linear_of_display(without) + c * with);
}

// Additional data of records for the sensor pass. An array is null if no channel needs
// it.
struct SensedRecords {
    const float* normal;      // (N, 3) in view space
    const int32_t* instance;  // (N); null: every record belongs to instance 0
    const int32_t* label;     // per instance; null: no instance has a label
};

// A pixel after its list was blended.
struct SensedPixel {
    float transmittance;  // negative if the pixel has stopped
    float median_depth;
    SensedMesh mesh;  // coverage 0: no mesh, or a hidden one
    SensedSums front, behind;
};

// Mixes the mesh into pixel `at` of the blended picture.
V3DG_HD V3DG_INLINE void mix_mesh(const SensedPixel& pixel, const SensedShares& share, size_t at,
                                  const MeshLayer& layer, const Picture<float>& picture) {
    if (pixel.mesh.coverage <= 0) return;
    for (int c = 0; c < 3; ++c) {
        float& color = picture.color[picture.color_step * at + c];
        color = mixed_color(color, pixel.front.color[c], layer.color[3 * at + c], pixel.mesh,
                            layer.light);
    }
    if (picture.alpha != nullptr) picture.alpha[picture.alpha_step * at] = share.alpha;
    if (picture.depth != nullptr)
        picture.depth[at] = blended_depth(pixel.front, pixel.behind, pixel.mesh, share);
}

// Writes the weight and the ids of the strongest contribution to pixel `at`.
V3DG_HD V3DG_INLINE void write_strongest(const Strongest& strongest, size_t at,
                                         const SensedRecords& sensed, const Sensor& sensor) {
    const SensorPlanes& planes = sensor.planes;
    const MeshLayer& mesh = sensor.mesh;
    if (planes.weight != nullptr) planes.weight[at] = strongest.weight;
    if (!planes.wants_ids()) return;
    int32_t instance = kNoInstance, label = kNoLabel;
    if (strongest.weight > 0 && strongest.record == kMeshRecord) {
        instance = mesh.instance == nullptr ? kMeshInstance : mesh.instance[at];
        if (mesh.label != nullptr) label = mesh.label[at];
    } else if (strongest.weight > 0) {
        instance = sensed.instance == nullptr ? 0 : sensed.instance[strongest.record];
        if (sensed.label != nullptr) label = sensed.label[instance];
    }
    if (planes.instance != nullptr) planes.instance[at] = instance;
    if (planes.label != nullptr) planes.label[at] = label;
}

// Writes the channels of pixel `at`, and mixes its mesh into the picture.
V3DG_HD V3DG_INLINE void write_pixel(const SensedPixel& pixel, size_t at, float min_transmittance,
                                     const SensedRecords& sensed, const Sensor& sensor,
                                     const Picture<float>& picture) {
    const SensorPlanes& planes = sensor.planes;
    const SensedShares share = shares_of(pixel.transmittance, min_transmittance, pixel.mesh);
    mix_mesh(pixel, share, at, sensor.mesh, picture);
    if (planes.median_depth != nullptr) planes.median_depth[at] = pixel.median_depth;
    if (planes.normal != nullptr) {
        const float* mesh_normal = sensor.mesh.normal;
        if (mesh_normal != nullptr) mesh_normal += 3 * at;
        blended_normal(pixel.front, pixel.behind, mesh_normal, share, planes.normal + 3 * at);
    }
    if (planes.wants_strongest())
        write_strongest(strongest_of(pixel.front, pixel.behind, share), at, sensed, sensor);
}

// Computes the unit normal along an axis of a gaussian, in view space, pointing towards
// the eye. `axis` is in model space, and may have any length. `p` is the gaussian's
// mean in view space.
V3DG_HD V3DG_INLINE void normal_along(const float axis[3], const ModelView<float>& view,
                                      const float p[3], float normal[3]) {
    for (int i = 0; i < 3; ++i)
        normal[i] = view.linear[3 * i] * axis[0] + view.linear[3 * i + 1] * axis[1] +
                    view.linear[3 * i + 2] * axis[2];
    const float length = sqrt_of(dot3(normal, normal));
    const float factor = (dot3(normal, p) > 0 ? -1.0f : 1.0f) / length;
    for (int k = 0; k < 3; ++k) normal[k] = length > 0 ? normal[k] * factor : 0.0f;
}

// Computes the normal of a gaussian in view space. It is the direction of its shortest
// axis, or of the first of equally short axes, pointing towards the eye. `p` is the
// gaussian's mean in view space.
V3DG_HD V3DG_INLINE void normal_of_gaussian(const float quat[4], const float scale[3],
                                            const ModelView<float>& view, const float p[3],
                                            float normal[3]) {
    int shortest = 0;
    for (int k = 1; k < 3; ++k)
        if (scale[k] < scale[shortest]) shortest = k;
    float r[9];
    rotation_of_quat(quat, r);
    const float axis[3] = {r[shortest], r[3 + shortest], r[6 + shortest]};
    normal_along(axis, view, p, normal);
}

// Sets the axes of a gaussian from the factor F of a PackedGaussian, divided by the
// length of the longest axis, so that products of small scales do not underflow.
// Returns that length.
//
// The first column of F is the longest axis, and the other two columns span the plane
// of the other axes. They are rotated until they are orthogonal, which makes them axes;
// this is one step of Jacobi's method for singular values.
V3DG_HD V3DG_INLINE float axes_of_factor(const float f[8], float longest[3], float middle[3],
                                         float shortest[3]) {
    constexpr float kSmallest = 1e-30f;
    const float length = max_of(sqrt_of(dot3(f, f)), kSmallest), unit = 1 / length;
    const float one[3] = {unit * f[3], unit * f[4], unit * f[5]};
    const float other[3] = {0, unit * f[6], unit * f[7]};
    const float difference = dot3(one, one) - dot3(other, other);
    const float twice = 2 * dot3(one, other);
    // The longer axis is cosine * one + sine * other. Its squared length is largest at
    // half the angle of the vector (difference, twice).
    const float size = sqrt_of(difference * difference + twice * twice);
    // cosine of the double angle
    const float cosine2 = size > 0 ? difference / size : 1.0f;
    const float cosine = sqrt_of(max_of(0.5f + 0.5f * cosine2, 0.0f));
    const float sine = sqrt_of(max_of(0.5f - 0.5f * cosine2, 0.0f)) * (twice < 0 ? -1.0f : 1.0f);
    for (int k = 0; k < 3; ++k) {
        longest[k] = unit * f[k];
        middle[k] = cosine * one[k] + sine * other[k];
        shortest[k] = cosine * other[k] - sine * one[k];
    }
    return length;
}

// Like normal_of_gaussian(), from the factor F of a PackedGaussian. If two axes are
// equally short, the normal is any vector in their plane. The cross product of the two
// longest axes is exact even if the gaussian is flat.
V3DG_HD V3DG_INLINE void normal_of_factor(const float f[8], const ModelView<float>& view,
                                          const float p[3], float normal[3]) {
    float longest[3], middle[3], shortest[3], axis[3];
    axes_of_factor(f, longest, middle, shortest);
    cross3(longest, middle, axis);
    normal_along(axis, view, p, normal);
}

}  // namespace v3dg

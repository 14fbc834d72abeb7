#pragma once

// The request for a frame, for all backends. It is created in Python, and the bindings
// pass it to a backend without changes.

#include <array>
#include <optional>
#include <vector>

#include "camera/camera.h"
#include "frame/image.h"
#include "frame/sensor.h"
#include "select/select.h"

namespace v3dg {

// What the colours of a picture show.
enum class FrameLook {
    appearance,  // the colours of the gaussians, or of a palette of clusters
    missing,     // which pages are missing; see missing_color()
    metrics,     // each cluster's metric divided by the tolerance, in grey
    count        // like `appearance`, but the depth plane receives the number of
                 // gaussians per pixel
};

// Options of blending: the background, the transmittance at which a pixel stops
// (frame/image.h), and whether to draw depth.
struct Shade {
    std::array<double, 3> background;
    float min_transmittance = kStopsBefore;
    bool with_depth = true;
};

struct FrameRequest {
    Eyes eyes;  // the camera of each picture
    // The rule of the cut. If `cut` is given, only the tolerance is used.
    SelectRule rule;
    Shade shade;
    FrameLook look = FrameLook::appearance;
    std::optional<GivenCut> cut = {};  // a cut to draw instead of selecting one
    // The eyes for which the cut is selected. Without a value, `eyes` is used.
    std::optional<Eyes> chooser = {};
    // Only for a frame with a pool: whether it draws just the resident pages, without
    // bringing in or requesting others.
    bool is_aside = false;
    // For each bundle, the colours of its clusters in host memory, as SH coefficients
    // of degree 0, [C][3]. If the vector is empty, the gaussians keep their colours.
    std::vector<const float*> cluster_colors = {};
    // Channels other than colour, and the meshes of the eyes, one after another.
    SensorRequest sensor = {};

    const Eyes& choosing_eyes() const { return chooser ? *chooser : eyes; }
    // Returns whether every backend can draw the request. Other requests can only be
    // drawn on the host.
    bool is_plain() const {
        return look == FrameLook::appearance && !is_aside && !chooser && cluster_colors.empty();
    }
};

// The request for a batch of pictures of one size. Each picture has its own camera and
// cut. The rule must not have a budget.
struct BatchRequest {
    SelectRule rule;
    Shade shade;  // `with_depth` is ignored: depth is drawn if there is a plane for it
    int width, height;
    BatchPlanes planes;
    // Channels and meshes of the pictures. The planes hold the pictures one after
    // another.
    Sensor sensor = {};
};

}  // namespace v3dg

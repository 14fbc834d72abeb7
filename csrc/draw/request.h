#pragma once

// The request for a frame, for all backends. Python creates this value, the bindings
// pass it to a backend, and nothing changes it on the way.

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
    missing,     // where finer pages are missing; see missing_color()
    metrics,     // each cluster's metric divided by the tolerance, in grey
    count        // like `appearance`, but the number of gaussians per pixel replaces depth
};

// Options of blending: the background, the transmittance at which a pixel stops
// (frame/image.h), and whether depth is drawn.
struct Shade {
    std::array<double, 3> background;
    float min_transmittance = kStopsBefore;
    bool with_depth = true;
};

struct FrameRequest {
    Eyes eyes;  // the camera of each picture
    // The rule of the cut. With a given `cut`, only its tolerance matters.
    SelectRule rule;
    Shade shade;
    FrameLook look = FrameLook::appearance;
    std::optional<GivenCut> cut = {};  // a cut to draw instead of selecting one
    // Eyes for which the cut is selected; default: `eyes`.
    std::optional<Eyes> chooser = {};
    // Whether a frame with a pool draws only the pages that are resident, and neither
    // brings in nor requests any pages.
    bool is_aside = false;
    // Per bundle: the colours of clusters in host memory, as SH coefficients of degree
    // 0, [C][3]. An empty vector keeps the gaussians' colours.
    std::vector<const float*> cluster_colors = {};
    // Channels beside colour, and the meshes of the eyes, one after another.
    SensorRequest sensor = {};

    const Eyes& choosing_eyes() const { return chooser ? *chooser : eyes; }
    // Returns whether every backend can draw the request. Other requests are drawn on
    // the host only.
    bool is_plain() const {
        return look == FrameLook::appearance && !is_aside && !chooser && cluster_colors.empty();
    }
};

// The request for pictures of one size, each with a cut for its own camera. The rule
// has no budget.
struct BatchRequest {
    SelectRule rule;
    Shade shade;  // ignores `with_depth`: depth is drawn if there are planes for it
    int width, height;
    BatchPlanes planes;
    // Channels and meshes of the pictures, one after another.
    Sensor sensor = {};
};

}  // namespace v3dg

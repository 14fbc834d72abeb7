#pragma once

// The request for a frame, the same on every device: one value that Python creates,
// that passes through the bindings to a backend, and that nobody changes on the way.

#include <array>
#include <optional>
#include <vector>

#include "camera/camera.h"
#include "frame/image.h"
#include "select/select.h"

namespace v3dg {

// What the colours of a picture show.
enum class FrameLook {
    appearance,  // the gaussians' colours, or a palette of cluster colours
    missing,     // where finer pages are missing; see missing_color()
    metrics,     // each pair's metric as a fraction of the tolerance, in grey
    count        // as appearance, but the depth is replaced by the number of gaussians per pixel
};

// The background, the transmittance at which pixels stop (frame/image.h), and whether
// depth is drawn.
struct Shade {
    std::array<double, 3> background;
    float min_transmittance = kStopsBefore;
    bool with_depth = true;
};

struct FrameRequest {
    Eyes eyes;        // the cameras of the pictures
    SelectRule rule;  // of the cut; of a given cut, only the tolerance
    Shade shade;
    FrameLook look = FrameLook::appearance;
    std::optional<GivenCut> cut = {};  // drawn instead of a selected cut
    std::optional<Eyes> chooser = {};  // eyes that the cut is selected for; if absent, `eyes`
    // With a pool: use the resident pages of the last frame, and neither bring pages in
    // nor request any.
    bool is_aside = false;
    // [C][3] per bundle, SH coefficients of degree 0: the colours of clusters in host
    // memory. Empty: none.
    std::vector<const float*> cluster_colors = {};

    const Eyes& choosing_eyes() const { return chooser ? *chooser : eyes; }
    // Whether every backend can draw it. Other requests are drawn on the host only.
    bool is_plain() const {
        return look == FrameLook::appearance && !is_aside && !chooser && cluster_colors.empty();
    }
};

}  // namespace v3dg

#pragma once

// What is asked of a frame, on every device: one value that goes from Python through the bindings
// to a backend, and is not changed on its way.

#include <array>
#include <optional>
#include <vector>

#include "camera/camera.h"
#include "frame/image.h"
#include "select/select.h"

namespace v3dg {

// What the colours of a picture say.
enum class FrameLook {
    appearance,  // what the gaussians, or the palette of their clusters, have
    missing,     // where finer pages are missing (see missing_color())
    metrics,     // the share of the tolerance that each pair's metric takes, as grey
    count        // as appearance; the number of gaussians of a pixel takes the place of depth
};

// What is behind the gaussians of a pixel, when it stops (frame/image.h), and whether its depth is
// drawn, too.
struct Shade {
    std::array<double, 3> background;
    float min_transmittance = kStopsBefore;
    bool with_depth = true;
};

struct FrameRequest {
    Eyes eyes;        // that see the pictures
    SelectRule rule;  // of the cut; with a given cut, the tolerance that metrics are compared with
    Shade shade;
    FrameLook look = FrameLook::appearance;
    std::optional<GivenCut> cut = {};  // drawn in place of what the rule selects
    std::optional<Eyes> chooser = {};  // that the cut is selected for; none: the eyes
    // From a pool: the pages that the last frame had; none come in, and none are asked for.
    bool is_aside = false;
    // [C][3] of each bundle, coefficients of the constant basis: colours of clusters that lie here
    // and there. Empty: none.
    std::vector<const float*> cluster_colors = {};

    const Eyes& choosing_eyes() const { return chooser ? *chooser : eyes; }
    // Whether any backend can draw it: the others show what only the host computes.
    bool is_plain() const {
        return look == FrameLook::appearance && !is_aside && !chooser && cluster_colors.empty();
    }
};

}  // namespace v3dg

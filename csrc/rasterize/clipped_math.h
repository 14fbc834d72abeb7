#pragma once

// Formulas of the channel `clipped`: the bodies of gaussians that are not drawn because
// their means are before the near plane, and the rays that meet these bodies.

#include "math/gaussian.h"
#include "math/quat.h"
#include "math/vec.h"
#include "math/view.h"

namespace v3dg {

// A gaussian that is not drawn because its mean is before the near plane, although its
// body extends beyond that plane. In the body, the alpha in space is at least 1/255.
struct ClippedBody {
    double mean[3];     // in view space
    double to_unit[9];  // row major; maps the body to a ball
    double reach2;      // squared radius of the ball
    // Bounds on x / z and y / z of the body beyond the near plane.
    double lo[2], hi[2];
};

// Sets the axes of a gaussian in view space as columns, row major.
V3DG_HD V3DG_INLINE void axes_in_view(const Gaussian3d<float>& g, const ModelView<float>& view,
                                      double axes[9]) {
    float r[9];
    rotation_of_quat(g.quat, r);
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
            double sum = 0;
            for (int j = 0; j < 3; ++j) sum += double(view.linear[3 * i + j]) * r[3 * j + k];
            axes[3 * i + k] = sum * g.scale[k];
        }
}

// Sets the bounds of a body. Beyond the near plane, depths are at most `far_depth`, so
// a coordinate divided by depth is largest at one of the two depths.
V3DG_HD V3DG_INLINE void set_bounds(const double axes[9], double near_depth, double far_depth,
                                    ClippedBody& body) {
    constexpr double kMargin = 1e-9;  // relative, for rounding
    for (int i = 0; i < 2; ++i) {
        double across = 0;
        for (int k = 0; k < 3; ++k) across += axes[3 * i + k] * axes[3 * i + k];
        const double half = sqrt(body.reach2 * across) * (1 + kMargin);
        const double lo = body.mean[i] - half, hi = body.mean[i] + half;
        const double margin = kMargin * (half + abs_of(body.mean[i])) / near_depth;
        body.lo[i] = lo / (lo < 0 ? near_depth : far_depth) - margin;
        body.hi[i] = hi / (hi < 0 ? far_depth : near_depth) + margin;
    }
}

// Sets a body. `axes` has its axes in view space as columns, row major. Returns false
// if the body does not extend beyond the near plane.
V3DG_HD V3DG_INLINE bool set_clipped_body(const double p[3], const double axes[9], double opacity,
                                          double near_depth, ClippedBody& body) {
    if (!(opacity >= kMinAlpha) || !(opacity <= 1)) return false;
    body.reach2 = 2 * log(opacity / kMinAlpha);
    double across = 0;
    for (int k = 0; k < 3; ++k) {
        body.mean[k] = p[k];
        across += axes[6 + k] * axes[6 + k];
        const double length2 =
            axes[k] * axes[k] + axes[3 + k] * axes[3 + k] + axes[6 + k] * axes[6 + k];
        if (!(length2 > 0)) return false;
        for (int i = 0; i < 3; ++i) body.to_unit[3 * k + i] = axes[3 * i + k] / length2;
    }
    const double far_depth = p[2] + sqrt(body.reach2 * across);
    if (!(p[2] < near_depth) || !(far_depth >= near_depth)) return false;
    set_bounds(axes, near_depth, far_depth, body);
    return true;
}

// Returns whether the ray from the eye through (x, y, 1) meets a body beyond the near
// plane.
V3DG_HD V3DG_INLINE bool meets_body(const ClippedBody& body, double x, double y,
                                    double near_depth) {
    if (x < body.lo[0] || x > body.hi[0] || y < body.lo[1] || y > body.hi[1]) return false;
    double a[3], b[3], ab = 0, aa = 0;
    for (int k = 0; k < 3; ++k) {
        const double* row = body.to_unit + 3 * k;
        a[k] = row[0] * x + row[1] * y + row[2];
        b[k] = dot3(row, body.mean);
        ab += a[k] * b[k];
        aa += a[k] * a[k];
    }
    const double nearest = ab / aa;  // depth of the point that is nearest in the ball
    const double depth = nearest > near_depth ? nearest : near_depth;
    double distance2 = 0;
    for (int k = 0; k < 3; ++k) distance2 += (depth * a[k] - b[k]) * (depth * a[k] - b[k]);
    return distance2 <= body.reach2;
}

}  // namespace v3dg

#pragma once

// The gradient of a picture with respect to the pose of its camera. The pose is the
// matrix R and the vector t that map a point x of the world to R x + t. The nine
// elements of R are independent variables, and the eye is -R⁻¹ t.

#include "camera/camera.h"
#include "math/gaussian.h"
#include "math/quat.h"
#include "math/view.h"

namespace v3dg {

// Sums over gaussians from which the gradient of a pose is computed.
template <class V>
struct PoseSums {
    V linear[9];     // gradient with respect to R, for points relative to ModelView::eye
    V shift[3];      // gradient with respect to t
    V direction[3];  // gradient with respect to the vectors from the eye to the
                     // gaussians
};
constexpr int kPoseValues = 15;
static_assert(sizeof(PoseSums<float>) == kPoseValues * sizeof(float), "");

template <class V>
V3DG_HD V3DG_INLINE void add(const PoseSums<V>& part, PoseSums<V>& sums) {
    for (int k = 0; k < 9; ++k) sums.linear[k] += part.linear[k];
    for (int k = 0; k < 3; ++k) {
        sums.shift[k] += part.shift[k];
        sums.direction[k] += part.direction[k];
    }
}

// A camera that also stores the gradients in view space that linearized_vjp() computes,
// namely those of a point and of a gaussian's axes.
template <ProjectingModel C, class V>
struct ViewProbe : C {
    V* d_point;  // (3)
    V* d_axes;   // (3, 3)

    template <class W>
    V3DG_HD V3DG_INLINE void linearized_vjp(const typename C::template Point<W>& at, const W p[3],
                                            const W m[9], const W a1[3], const W a2[3],
                                            const LinearImage<W>& d, W d_p[3], W d_m[9]) const {
        C::linearized_vjp(at, p, m, a1, a2, d, d_p, d_m);
        if constexpr (std::is_same_v<W, V>) {
            for (int k = 0; k < 3; ++k) d_point[k] = d_p[k];
            for (int k = 0; k < 9; ++k) d_axes[k] = d_m[k];
        }
    }
};

// Returns the camera, as a ViewProbe if `kIsProbed`.
template <bool kIsProbed, ProjectingModel C, class V>
V3DG_HD V3DG_INLINE auto probed(const C& camera, V* d_point, V* d_axes) {
    if constexpr (kIsProbed)
        return ViewProbe<C, V>{camera, d_point, d_axes};
    else
        return camera;
}

// Computes the terms of one gaussian from three gradients: of its centre and of its
// axes in view space (ViewProbe), and of the vector from the eye to its centre.
template <class V, class T>
V3DG_HD V3DG_INLINE void pose_vjp(const Gaussian3d<V>& g, const ModelView<T>& view,
                                  const V d_point[3], const V d_axes[9], const V d_direction[3],
                                  PoseSums<V>& sums) {
    V r[9];
    rotation_of_quat(g.quat, r);
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
            V sum = d_point[row] * (g.mean[column] - view.eye[column]);
            for (int k = 0; k < 3; ++k)
                sum += d_axes[3 * row + k] * (r[3 * column + k] * g.scale[k]);
            sums.linear[3 * row + column] = sum;
        }
        sums.shift[row] = d_point[row];
        sums.direction[row] = d_direction[row];
    }
}

// Computes the gradient (3, 4) of the matrix [R t].
template <class T>
V3DG_HD inline void pose_gradient(const PoseSums<double>& sums, const ModelView<T>& view,
                                  double d_pose[12]) {
    for (int row = 0; row < 3; ++row) {
        double by_eye = 0;
        for (int k = 0; k < 3; ++k)
            by_eye += static_cast<double>(view.linear[3 * row + k]) * sums.direction[k];
        for (int column = 0; column < 3; ++column) {
            const double leading = view.eye[column];
            const double eye = leading + static_cast<double>(view.eye_rest[column]);
            d_pose[4 * row + column] =
                sums.linear[3 * row + column] + sums.shift[row] * leading + by_eye * eye;
        }
        d_pose[4 * row + 3] = sums.shift[row] + by_eye;
    }
}

}  // namespace v3dg

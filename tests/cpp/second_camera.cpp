// Projects gaussians with a second camera model, an orthographic one. The test shows
// what a camera model has to supply, and that projection works with any model. Prints
// what is wrong, if anything.

#include <cmath>
#include <cstdio>

#include "camera/camera.h"
#include "project/project_math.h"

namespace v3dg {

struct NoLimits {};
template <class V>
struct NoPoint {};
struct Edges {
    double half_width, half_height;
};

// An orthographic camera. The point (x, y, z) in view space is drawn at pixel
// (zoom x + cx, zoom y + cy).
template <class T>
struct Orthographic {
    using Scalar = T;
    using Limits = NoLimits;
    using Sides = Edges;
    template <class V>
    using Point = NoPoint<V>;
    static constexpr int kNumPlanes = 1;

    T zoom, cx, cy;
    T width, height;
    T near_depth;

    template <class U>
    Orthographic<U> rounded_to() const {
        return {U(zoom), U(cx), U(cy), U(width), U(height), U(near_depth)};
    }
    void scale(T factor) {
        for (T* px : {&zoom, &cx, &cy, &width, &height}) *px *= factor;
    }
    void crop(T left, T top, T new_width, T new_height) {
        cx -= left;
        cy -= top;
        width = new_width;
        height = new_height;
    }
    template <class V>
    V depth_of(const V p[3]) const {
        return p[2];
    }
    NoLimits limits() const { return {}; }
    template <class V>
    NoPoint<V> linearized(const NoLimits&, const V*) const {
        return {};
    }
    template <class V>
    void to_pixel(const NoPoint<V>&, const V p[3], V& u, V& v) const {
        u = zoom * p[0] + cx;
        v = zoom * p[1] + cy;
    }
    template <class V, class W>
    void times_jacobian(const NoPoint<V>&, const W& x, const W& y, const W&, V& a1, V& a2) const {
        a1 = zoom * x;
        a2 = zoom * y;
    }
    template <class V>
    void linearized_vjp(const NoPoint<V>&, const V*, const V*, const V*, const V*,
                        const LinearImage<V>& d, V d_p[3], V d_m[9]) const {
        for (int k = 0; k < 3; ++k) {
            d_m[k] = zoom * d.a1[k];
            d_m[3 + k] = zoom * d.a2[k];
            d_m[6 + k] = V{};
        }
        d_p[0] = zoom * d.u;
        d_p[1] = zoom * d.v;
        d_p[2] = d.depth;
    }
    T sphere_scale(const NoLimits&, T squared_model_scale) const {
        return zoom * std::sqrt(squared_model_scale);
    }
    SphereImage<T> image_of_sphere(const T p[3], T radius, T sphere_scale, T filter_px2) const {
        const T reach = sphere_scale * radius;
        return {zoom * p[0] + cx, zoom * p[1] + cy,
                std::sqrt(reach * reach + T(kReachSigmas * kReachSigmas) * filter_px2)};
    }
    T px2_per_steradian() const { return zoom * zoom; }
    template <class Eye>
    static Edges sides_of(const Eye eyes[2], int, double pad_px) {
        return {eyes[0].width / 2 + pad_px, eyes[0].height / 2 + pad_px};
    }
    double front_offset(const InstanceAxes& in, double inverse_scale) const {
        return near_depth * inverse_scale - in.origin[2];
    }
    static void set_guard_direction(const InstanceAxes& in, float direction[3]) {
        for (int k = 0; k < 3; ++k) direction[k] = static_cast<float>(in.axes[6 + k]);
    }
    static void set_planes(const Edges&, const InstanceAxes& first, const InstanceAxes&,
                           double front_offset, Plane* plane) {
        for (int k = 0; k < 3; ++k) plane->normal[k] = static_cast<float>(-first.axes[6 + k]);
        plane->offset = static_cast<float>(front_offset);
        plane->guard = 0;
    }
};

static_assert(CameraModel<Orthographic<float>> && CameraModel<Orthographic<double>>);

// An incomplete camera model: it has no to_pixel().
struct Blind : Orthographic<float> {
    void to_pixel() = delete;
};
static_assert(!CameraModel<Blind>);

}  // namespace v3dg

using namespace v3dg;

using Camera2 = Orthographic<double>;

constexpr double kFilter = 0.3;

static ModelView<double> a_view() {
    ModelView<double> view{};
    const double linear[9] = {0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1};
    for (int k = 0; k < 9; ++k) view.linear[k] = linear[k];
    view.translation[2] = 4;
    return view;
}

static Ellipse<double> projected(const Gaussian3d<double>& g, Projection<double, Camera2>& s,
                                 const Camera2& camera) {
    const ModelView<double> view = a_view();
    to_view(view, g.mean, s.p);
    return project_gaussian(g, view, camera, kFilter, true, s);
}

// Returns a loss that depends on every value of the ellipse.
static double loss_of(const Gaussian3d<double>& g, const Camera2& camera) {
    Projection<double, Camera2> s;
    const Ellipse<double> e = projected(g, s, camera);
    return 0.3 * e.u - 0.2 * e.v + 5 * e.l11 + 7 * e.l12 - 3 * e.l22 + 2 * e.log2_opacity +
           0.5 * e.depth;
}

static int failures = 0;
static void expect_close(const char* name, double got, double wanted) {
    if (std::fabs(got - wanted) <= 1e-6 * (1 + std::fabs(wanted))) return;
    std::printf("%s: expected %.9g, got %.9g\n", name, wanted, got);
    ++failures;
}

int main() {
    const Camera2 camera{20, 64, 48, 128, 96, 0.1};
    const Gaussian3d<double> g{{0.5, -0.3, 0.7}, {0.9, 0.1, -0.3, 0.2}, {0.2, 0.05, 0.1}, 0.6};
    Projection<double, Camera2> s;
    const Ellipse<double> e = projected(g, s, camera);
    expect_close("u", e.u, 20 * (0.8 * 0.5 + 0.6 * 0.3) + 64);
    expect_close("v", e.v, 20 * (0.6 * 0.5 - 0.8 * 0.3) + 48);
    expect_close("depth", e.depth, 4.7);
    // The determinant of the covariance follows from the determinant of L.
    const double det_l = e.l11 * e.l22;
    expect_close("det", s.det * det_l * det_l, std::pow(kFalloffScale, 4));

    const ModelView<double> view = a_view();
    const Ellipse<double> d{0.3, -0.2, 5, 7, -3, 2, 0.5};
    const Gaussian3d<double> gradient =
        project_gaussian_vjp(g, view, camera, kFilter, true, s, e, d);
    const double* slopes = &gradient.mean[0];
    const char* names[11] = {"mean x", "mean y",  "mean z",  "quat w",  "quat x", "quat y",
                             "quat z", "scale x", "scale y", "scale z", "opacity"};
    for (int k = 0; k < 11; ++k) {
        constexpr double kStep = 1e-6;
        Gaussian3d<double> before = g, after = g;
        (&before.mean[0])[k] -= kStep;
        (&after.mean[0])[k] += kStep;
        const double slope = (loss_of(after, camera) - loss_of(before, camera)) / (2 * kStep);
        if (std::fabs(slopes[k] - slope) > 1e-5 * (1 + std::fabs(slope))) {
            std::printf("gradient of %s: expected %.9g, got %.9g\n", names[k], slope, slopes[k]);
            ++failures;
        }
    }
    const SphereImage<double> sphere =
        camera.image_of_sphere(s.p, 3.33 * 0.2, camera.sphere_scale({}, 1.0), kFilter);
    double half_x, half_y;
    extent_of(g.opacity, e, s, half_x, half_y);
    if (!(half_x <= sphere.half && half_y <= sphere.half)) {
        std::printf("half: expected at least %g and %g, got %g\n", half_x, half_y, sphere.half);
        ++failures;
    }
    const PixelBox<int> box = pixel_box(e, half_x, half_y, camera);
    if (!box.holds_pixels()) {
        std::printf("box: expected pixels, got none\n");
        ++failures;
    }
    return failures != 0;
}

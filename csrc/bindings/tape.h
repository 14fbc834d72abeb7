#pragma once

// One picture of gaussians without levels, and its gradients.

#include <optional>

#include "bindings/picture.h"
#include "draw/render.h"

namespace v3dg {

// The requested gradients with respect to the gaussians' centres.
struct Centers {
    bool sum, size;
};

// The gradients of a picture, as arrays on the device of the gaussians. An array that
// was not requested is None.
struct Gradients {
    py::object means, quats, scales, opacities, sh, background;
    py::object centers = py::none();       // (N, 2) with respect to the centres, 1 / px
    py::object center_sizes = py::none();  // (N, 2) sums of absolute values over pixels
    py::object poses = py::none();         // (V, 3, 4) with respect to the poses of V views
};

// The results of rasterize() that its backward pass needs.
class Tape {
  public:
    virtual ~Tape() = default;
    virtual Gradients backward(const py::object& d_color, const py::object& d_alpha,
                               const py::object& d_depth, Centers wanted) = 0;
};

// The settings of a picture, in addition to gaussians and camera.
struct DrawLook {
    double filter_px2;
    bool antialiased;
    std::array<double, 3> background;
    bool plain_colors;  // whether coefficients (of degree 0) are used directly as
                        // colours

    template <class T>
    GaussianRows<const T> read(const Rows& gaussians) const {
        GaussianRows<const T> rows = gaussians.read<T>();
        if (plain_colors) rows.sh_degree = kPlainColor;
        return rows;
    }
};

// Throws ValueError unless gaussians have coefficients of degree 0 only, which plain
// colours require.
void check_plain_colors(const Rows& gaussians);

// A picture. `counts` are only set on the host. `tape` is null if it was not requested.
struct Rasterized {
    py::object color, alpha, depth;
    std::optional<RenderCounts> counts;
    std::unique_ptr<Tape> tape;
};

// Checks the arguments, and draws on the device of the gaussians.
Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape);

// The gradient of one plane of a picture. None becomes zeros.
template <class T>
struct GradientPlane {
    py::object object;
    Span<const T> span;

    GradientPlane(const py::object& given, const char* name, Device device, const Shape& shape)
        : object(given.is_none() ? zeros(device, shape) : given),
          span(span_on<const T>(device, object, name, shape)) {}

  private:
    // NumPy arrays have fill(), torch tensors fill_().
    static py::object zeros(Device device, const Shape& shape) {
        const py::object array = make_array(device, element_of<T>(), shape).object;
        array.attr(py::isinstance<py::array>(array) ? "fill" : "fill_")(0);
        return array;
    }
};

}  // namespace v3dg

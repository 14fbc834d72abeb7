#pragma once

// One picture of gaussians without levels, and its gradients, as backends return them.

#include <optional>

#include "bindings/picture.h"
#include "draw/render.h"

namespace v3dg {

// The requested gradients with respect to the gaussians' centres on the image.
struct Centers {
    bool sum, size;
};

// The gradients of a picture, arrays on the device of its gaussians; None for those not
// requested.
struct Gradients {
    py::object means, quats, scales, opacities, sh, background;
    py::object centers = py::none();       // (N, 2), by the centres on the image
    py::object center_sizes = py::none();  // (N, 2), of the absolute values of pixels
};

// The data that rasterize() leaves for its backward pass.
class Tape {
  public:
    virtual ~Tape() = default;
    virtual Gradients backward(const py::object& d_color, const py::object& d_alpha,
                               const py::object& d_depth, Centers wanted) = 0;
};

// The settings of one picture besides gaussians and camera.
struct DrawLook {
    double filter_px2;
    bool antialiased;
    std::array<double, 3> background;
    bool plain_colors;  // the coefficients, of degree 0, are used directly as colours

    template <class T>
    GaussianRows<const T> read(const Rows& gaussians) const {
        GaussianRows<const T> rows = gaussians.read<T>();
        if (plain_colors) rows.sh_degree = kPlainColor;
        return rows;
    }
};

// A picture, its statistics on the host, and the tape or null.
struct Rasterized {
    py::object color, alpha, depth;
    std::optional<RenderCounts> counts;
    std::unique_ptr<Tape> tape;
};

// Draws with the backend of the gaussians' device, after checks.
Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape);

// Returns the gradient of a plane of the picture, or zeros if none is given.
template <class T>
struct GradientPlane {
    py::object object;
    Span<const T> span;

    GradientPlane(const py::object& given, const char* name, Device device,
                  const std::vector<py::ssize_t>& shape)
        : object(given.is_none() ? zeros(device, shape) : given) {
        span = shape.size() == 3
                   ? span_on<const T>(device, object, name, {shape[0], shape[1], shape[2]})
                   : span_on<const T>(device, object, name, {shape[0], shape[1]});
    }

  private:
    // NumPy arrays are filled here; torch tensors fill themselves with fill_().
    static py::object zeros(Device device, const std::vector<py::ssize_t>& shape) {
        const py::object array = make_array(device, element_of<T>(), shape).object;
        array.attr(py::isinstance<py::array>(array) ? "fill" : "fill_")(0);
        return array;
    }
};

}  // namespace v3dg

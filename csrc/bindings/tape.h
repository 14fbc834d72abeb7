#pragma once

// One picture of gaussians without levels, and its gradients, as backends make them.

#include <optional>

#include "bindings/picture.h"
#include "draw/render.h"

namespace v3dg {

// Which gradients by the gaussians' centres on the image are wanted.
struct Centers {
    bool sum, size;
};

// Gradients of a picture, arrays where its gaussians are; None for those that are not wanted.
struct Gradients {
    py::object means, quats, scales, opacities, sh, background;
    py::object centers = py::none();       // (N, 2), by the centres on the image
    py::object center_sizes = py::none();  // (N, 2), of the absolute values of pixels
};

// What rasterize leaves for rasterize_backward.
class Tape {
  public:
    virtual ~Tape() = default;
    virtual Gradients backward(const py::object& d_color, const py::object& d_alpha,
                               const py::object& d_depth, Centers wanted) = 0;
};

// What one picture is drawn with, beside gaussians and camera.
struct DrawLook {
    double filter_px2;
    bool antialiased;
    std::array<double, 3> background;
    bool plain_colors;  // the coefficients, of degree 0, are colours as they are

    template <class T>
    GaussianRows<const T> read(const Rows& gaussians) const {
        GaussianRows<const T> rows = gaussians.read<T>();
        if (plain_colors) rows.sh_degree = kPlainColor;
        return rows;
    }
};

// A picture, what it came to on the host, and the tape or null.
struct Rasterized {
    py::object color, alpha, depth;
    std::optional<RenderCounts> counts;
    std::unique_ptr<Tape> tape;
};

// Draws with the backend of the gaussians, after checks.
Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape);

// The gradient of a plane of the picture; where none is given, zeros.
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
    // NumPy's arrays are filled, and torch's tensors fill_() themselves.
    static py::object zeros(Device device, const std::vector<py::ssize_t>& shape) {
        const py::object array = make_array(device, element_of<T>(), shape).object;
        array.attr(py::isinstance<py::array>(array) ? "fill" : "fill_")(0);
        return array;
    }
};

}  // namespace v3dg

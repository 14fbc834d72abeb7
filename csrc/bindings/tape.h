#pragma once

// One picture of gaussians, and its gradients, for bindings that draw.

#include "bindings/types.h"

namespace v3dg {

// What is wanted of the gradients by the gaussians' centres on the image.
struct Centers {
    bool sum, size;
};

// What rasterize leaves for rasterize_backward.
class Tape {
  public:
    virtual ~Tape() = default;
    // Gradients of means, quats, scales, opacities, sh and background; sum and size of those by the
    // centres.
    virtual py::tuple backward(const py::object& d_color, const py::object& d_alpha,
                               const py::object& d_depth, Centers wanted) = 0;
};

// What one picture is drawn with, beside gaussians and camera.
struct Look {
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

// Colour, alpha, depth or None, counts and times or None, and the tape or None.
py::tuple rasterize(const Rows& gaussians, const BoundCamera& camera, const Look& look,
                    bool with_depth, bool keep_tape);

}  // namespace v3dg

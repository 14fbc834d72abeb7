#pragma once

#include <array>

#include "bindings/args.h"
#include "math/gaussian.h"

namespace v3dg {

// (fx, fy, cx, cy, near) and the image's size.
template <class T>
inline Pinhole<T> pinhole_of(const std::array<double, 5>& k, int width, int height) {
    if (width < 1 || height < 1 || width > UINT16_MAX || height > UINT16_MAX)
        throw py::value_error("width, height: expected 1 to 65535 px, got " + std::to_string(width) + " x " +
                              std::to_string(height));
    return {T(k[0]), T(k[1]), T(k[2]), T(k[3]), T(width), T(height), T(k[4])};
}

// 15 numbers: the linear part of model -> view row by row, its translation, the eye in the model's frame.
template <class T>
inline ModelView<T> view_of(const double* v) {
    ModelView<T> mv;
    for (int i = 0; i < 9; ++i) mv.linear[i] = T(v[i]);
    for (int i = 0; i < 3; ++i) mv.translation[i] = T(v[9 + i]);
    for (int i = 0; i < 3; ++i) mv.eye[i] = T(v[12 + i]);
    return mv;
}

// Degree of coefficients of shape (N, K, 3).
inline int degree_of_bases(py::ssize_t bases, const std::string& shape) {
    int degree = 0;
    while (degree <= 3 && num_sh_bases(degree) != bases) ++degree;
    if (degree > 3)
        throw py::value_error("sh: expected shape (N, K, 3) with K of 1, 4, 9 or 16, got " + shape);
    return degree;
}

}  // namespace v3dg

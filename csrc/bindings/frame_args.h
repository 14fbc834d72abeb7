#pragma once

// What a CUDA frame reads and writes, from arrays on the device.

#include "bindings/device_args.h"
#include "bindings/render_args.h"
#include "pipeline/scene_frame.h"

namespace v3dg {

inline cudaStream_t stream_of(uintptr_t handle) { return reinterpret_cast<cudaStream_t>(handle); }

// Borrows (means, quats, scales, opacities, sh) on the device.
inline GaussianRows<const float> rows_of(const py::handle& arrays) {
    const py::tuple t = arrays.cast<py::tuple>();
    const py::tuple shape = py::getattr(t[4], "shape").cast<py::tuple>();
    const py::ssize_t bases = shape.size() == 3 ? shape[1].cast<py::ssize_t>() : -1;
    const int degree = degree_of_bases(bases, py::str(shape).cast<std::string>());
    const Span<const float> opacities = device_span_of<const float>(t[3], "opacities", {-1});
    const py::ssize_t n = static_cast<py::ssize_t>(opacities.size);
    const GaussianRows<const float> rows{device_span_of<const float>(t[0], "means", {n, 3}).data,
                                         device_span_of<const float>(t[1], "quats", {n, 4}).data,
                                         device_span_of<const float>(t[2], "scales", {n, 3}).data,
                                         opacities.data,
                                         device_span_of<const float>(t[4], "sh", {n, bases, 3}).data,
                                         static_cast<size_t>(n),
                                         degree};
    for (const float* start : {rows.quats, rows.sh})
        if (reinterpret_cast<uintptr_t>(start) % 16 != 0)
            throw py::value_error("quats, sh: expected memory that begins at a multiple of 16 bytes");
    return rows;
}

// Of color (H, W, 3), alpha (H, W) and depth (H, W), on the device.
inline cuda::FrameImage image_of(const std::array<double, 5>& k, const std::array<double, 3>& background,
                                 const py::tuple& picture) {
    const py::tuple shape = py::getattr(picture[1], "shape").cast<py::tuple>();
    if (shape.size() != 2)
        throw py::value_error("alpha: expected shape (H, W), got " + py::str(shape).cast<std::string>());
    const int height = shape[0].cast<int>(), width = shape[1].cast<int>();
    const float b[3] = {float(background[0]), float(background[1]), float(background[2])};
    return cuda::frame_image(pinhole_of<float>(k, width, height), width, height, b,
                             device_span_of<float>(picture[0], "color", {height, width, 3}).data,
                             device_span_of<float>(picture[1], "alpha", {height, width}).data,
                             device_span_of<float>(picture[2], "depth", {height, width}).data);
}

}  // namespace v3dg

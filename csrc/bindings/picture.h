#pragma once

// The memory of a new picture.

#include "bindings/sensor.h"
#include "bindings/types.h"

namespace v3dg {

template <class T>
struct NewPlanes {
    T *color, *alpha, *depth;  // (H, W, 3), (H, W), and (H, W) or null
};

struct NewPicture {
    py::ssize_t height, width;
    py::object color, alpha, depth;  // `depth` is None if not requested
    bool with_depth;
    NewChannels channels;

    NewPicture(const Window& window, bool with_depth)
        : height(window.height()),
          width(window.width()),
          depth(py::none()),
          with_depth(with_depth) {}

    // Allocates the arrays.
    template <class T>
    NewPlanes<T> allocate(Device device) {
        const NewArray<T> color_plane(device, {height, width, 3});
        const NewArray<T> alpha_plane(device, {height, width});
        color = color_plane.object;
        alpha = alpha_plane.object;
        if (!with_depth)
            return {
                .color = color_plane.span.data, .alpha = alpha_plane.span.data, .depth = nullptr};
        const NewArray<T> depth_plane(device, {height, width});
        depth = depth_plane.object;
        return {.color = color_plane.span.data,
                .alpha = alpha_plane.span.data,
                .depth = depth_plane.span.data};
    }
};

// The pictures of a frame: one for a camera, or two for a stereo camera, left first.
using NewPictures = std::vector<NewPicture>;

}  // namespace v3dg

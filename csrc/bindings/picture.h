#pragma once

#include "bindings/types.h"
#include "frame/image.h"

#if V3DG_WITH_CUDA
#include "draw/scene_frame_cuda.h"
#endif

namespace v3dg {

// What is behind the gaussians of a pixel, when it stops (frame/image.h), and whether its depth is
// drawn, too.
struct Shade {
    std::array<double, 3> background;
    float min_transmittance = kStopsBefore;
    bool with_depth = true;
};

// The planes of a new picture, to be filled in: colour (H, W, 3), alpha and, where it is wanted,
// depth (H, W).
struct NewPicture {
    py::ssize_t height, width;
    py::object color, alpha, depth;
    bool with_depth;

    template <class T>
    Picture<T> on_host(const Window& window, const Shade& shade) {
        const NewArray<T> color_plane({}, {height, width, 3}), alpha_plane({}, {height, width});
        color = color_plane.object;
        alpha = alpha_plane.object;
        Picture<T> picture{window,
                           {T(shade.background[0]), T(shade.background[1]), T(shade.background[2])},
                           color_plane.span.data,
                           alpha_plane.span.data,
                           nullptr,
                           nullptr,
                           shade.min_transmittance};
        if (with_depth) {
            const NewArray<T> depth_plane({}, {height, width});
            depth = depth_plane.object;
            picture.depth = depth_plane.span.data;
        }
        return picture;
    }

#if V3DG_WITH_CUDA
    cuda::PicturePlanes on_device(Device device) {
        const NewArray<float> color_plane(device, {height, width, 3}),
            alpha_plane(device, {height, width});
        color = color_plane.object;
        alpha = alpha_plane.object;
        if (!with_depth) return {color_plane.span.data, alpha_plane.span.data, nullptr};
        const NewArray<float> depth_plane(device, {height, width});
        depth = depth_plane.object;
        return {color_plane.span.data, alpha_plane.span.data, depth_plane.span.data};
    }
    cuda::FrameImage frame_image(const Camera& camera, const Shade& shade,
                                 const cuda::PicturePlanes& planes = {}) const {
        const auto& of = shade.background;
        const float b[3] = {float(of[0]), float(of[1]), float(of[2])};
        return cuda::frame_image(camera.intrinsics<float>(), static_cast<int>(width),
                                 static_cast<int>(height), b, planes);
    }
#endif
};

}  // namespace v3dg

// Views of gaussians without levels on CUDA devices. Many views are drawn in parts, each
// of which is one frame.

#include <algorithm>

#include "bindings/cuda_frame.h"
#include "draw/views_frame_cuda.h"

namespace v3dg::cuda {

namespace {

// The views of one frame, beginning with view `first`.
struct Part {
    size_t first, count;
    std::unique_ptr<ViewsFrame> frame;
};

class DeviceViewsTape final : public ViewsTape {
  public:
    // Keeps the gaussians alive, because backward() reads them again.
    DeviceViewsTape(const std::vector<Rows>& gaussians, std::vector<Part> parts,
                    std::vector<py::ssize_t> shape)
        : gaussians_(gaussians), parts_(std::move(parts)), shape_(std::move(shape)) {}
    ~DeviceViewsTape() override {
        for (Part& part : parts_) give_back(std::move(part.frame));
    }

    Gradients backward(const py::object& d_color, const py::object& d_alpha,
                       const py::object& d_depth, const ViewsWanted& wanted) override {
        const Device device = gaussians_[0].device();
        const Work work(device);
        const ViewsGradientPlanes<float> planes(device, shape_, d_color, d_alpha, d_depth);
        Gradients made;
        const auto make = [device](const Shape& shape, py::object& object) {
            return new_elements<float>(device, shape, object);
        };
        const NewViewsGradients<float> arrays(gaussians_[0].size(), gaussians_[0].sh_degree(),
                                              shape_[0], wanted, made, make);
        const ViewsGradients out{.rows = arrays.rows,
                                 .has_opacities_for_each_view = wanted.opacities_for_each_view,
                                 .has_sh_for_each_view = wanted.sh_for_each_view,
                                 .centers = arrays.centers,
                                 .poses = arrays.poses};
        const Unlocked unlocked;
        for (const Part& part : parts_) {
            std::vector<PictureGradient<float>> d_pictures;
            for (size_t k = 0; k < part.count; ++k)
                d_pictures.push_back(planes.of_view(part.first + k));
            part.frame->backward(d_pictures, out.from(part.first), part.first > 0,
                                 arrays.background + 3 * part.first, stream_of(work));
        }
        return made;
    }

  private:
    std::vector<Rows> gaussians_;
    std::vector<Part> parts_;
    std::vector<py::ssize_t> shape_;  // number of views, height, width
};

// Returns the input of the views from `first` on.
ViewsInput input_of(const std::vector<Rows>& gaussians, const std::vector<Camera>& cameras,
                    const ViewsLook& look, const NewViews<float>& made, size_t first,
                    size_t count) {
    ViewsInput in{.models = {},
                  .views = {},
                  .images = {},
                  .filter_px2 = static_cast<float>(look.filter_px2),
                  .antialiased = look.antialiased};
    for (size_t view = first; view < first + count; ++view) {
        const Camera& camera = cameras[view];
        const DrawLook of_view = look.of_view(view);
        if (view == first || gaussians.size() > 1)
            in.models.push_back(of_view.read<float>(gaussians[gaussians.size() > 1 ? view : 0]));
        in.views.push_back(view_of_world<float>(camera));
        const size_t skipped =
            view * static_cast<size_t>(camera.width) * static_cast<size_t>(camera.height);
        const PicturePlanes planes{
            made.color_plane + 3 * skipped, made.alpha_plane + skipped,
            made.depth_plane == nullptr ? nullptr : made.depth_plane + skipped, false};
        FrameImage image = image_of(camera, Shade{.background = of_view.background}, planes);
        image.first_tile = static_cast<uint32_t>(view - first) * num_tiles_of(image);
        in.images.push_back(image);
    }
    return in;
}

}  // namespace

RasterizedViews rasterize_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                const ViewsLook& look, bool with_depth, bool keep_tape) {
    const Device device = gaussians[0].device();
    const Work work(device);
    const NewViews<float> made(device, cameras, with_depth);
    const std::vector<Camera> views = cameras.on_host();
    const size_t num_pixels =
        static_cast<size_t>(cameras.width()) * static_cast<size_t>(cameras.height());
    const size_t most = most_views(gaussians[0].size(), num_pixels);
    std::vector<Part> parts;
    {
        const Unlocked unlocked;
        for (size_t first = 0; first < views.size(); first += most) {
            const size_t count = std::min(most, views.size() - first);
            Part part{.first = first, .count = count, .frame = take_views_frame()};
            part.frame->draw(input_of(gaussians, views, look, made, first, count), stream_of(work));
            parts.push_back(std::move(part));
        }
    }
    auto tape = std::make_unique<DeviceViewsTape>(
        gaussians, std::move(parts),
        std::vector<py::ssize_t>{static_cast<py::ssize_t>(views.size()), cameras.height(),
                                 cameras.width()});
    return {.color = made.color,
            .alpha = made.alpha,
            .depth = made.depth,
            .tape = keep_tape ? std::move(tape) : nullptr};
}

}  // namespace v3dg::cuda

// Views of gaussians without levels on CUDA devices. Many views are drawn in parts, each
// of which is one frame.

#include <algorithm>

#include "bindings/cuda_frame.h"
#include "draw/views_frame_cuda.h"

namespace v3dg::cuda {

namespace {

// A part of the views: those from `first` on.
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
        const ViewsGradients out = new_gradients(wanted, made);
        const NewArray<float> background(device, {shape_[0], 3});
        made.background = background.object;
        const Unlocked unlocked;
        for (const Part& part : parts_) {
            std::vector<PictureGradient<float>> d_pictures;
            for (size_t k = 0; k < part.count; ++k)
                d_pictures.push_back(planes.of_view(part.first + k));
            part.frame->backward(d_pictures, out.from(part.first), part.first > 0,
                                 background.span.data + 3 * part.first, stream_of(work));
        }
        return made;
    }

  private:
    float* new_array(const std::vector<py::ssize_t>& shape, py::object& object) const {
        const NewArray<float> array(gaussians_[0].device(), shape);
        object = array.object;
        return array.span.data;
    }

    ViewsGradients new_gradients(const ViewsWanted& wanted, Gradients& made) const {
        const auto n = static_cast<py::ssize_t>(gaussians_[0].size());
        const int degree = gaussians_[0].sh_degree();
        const py::ssize_t bases = num_sh_bases(degree);
        const py::ssize_t num_views = shape_[0];
        const auto shape = [&](bool for_each_view, std::vector<py::ssize_t> of_view) {
            if (for_each_view) of_view.insert(of_view.begin(), num_views);
            return of_view;
        };
        ViewsGradients out{};
        out.rows = {
            .means = new_array({n, 3}, made.means),
            .quats = new_array({n, 4}, made.quats),
            .scales = new_array({n, 3}, made.scales),
            .opacities = new_array(shape(wanted.opacities_for_each_view, {n}), made.opacities),
            .sh = new_array(shape(wanted.sh_for_each_view, {n, bases, 3}), made.sh),
            .size = gaussians_[0].size(),
            .sh_degree = degree};
        out.has_opacities_for_each_view = wanted.opacities_for_each_view;
        out.has_sh_for_each_view = wanted.sh_for_each_view;
        if (wanted.centers.sum) out.centers.sum = new_array({num_views, n, 2}, made.centers);
        if (wanted.centers.size)
            out.centers.size = reinterpret_cast<CenterSize<float>*>(
                new_array({num_views, n, 2}, made.center_sizes));
        if (wanted.poses) out.poses = new_array({num_views, 3, 4}, made.poses);
        return out;
    }

    std::vector<Rows> gaussians_;
    std::vector<Part> parts_;
    std::vector<py::ssize_t> shape_;  // views, height, width
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
        const auto width = static_cast<int>(camera.width);
        const auto height = static_cast<int>(camera.height);
        const size_t skipped = view * static_cast<size_t>(width) * static_cast<size_t>(height);
        const float background[3] = {static_cast<float>(of_view.background[0]),
                                     static_cast<float>(of_view.background[1]),
                                     static_cast<float>(of_view.background[2])};
        const PicturePlanes planes{
            made.color_plane + 3 * skipped, made.alpha_plane + skipped,
            made.depth_plane == nullptr ? nullptr : made.depth_plane + skipped, false};
        FrameImage image =
            frame_image(camera.intrinsics<float>(), width, height, background, planes);
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

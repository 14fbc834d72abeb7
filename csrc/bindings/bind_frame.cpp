#include "bindings/args.h"

#if V3DG_WITH_CUDA

#include <memory>

#include "bindings/device_args.h"
#include "bindings/render_args.h"
#include "bindings/select_args.h"
#include "pipeline/scene_frame.h"

namespace v3dg {

namespace {

using namespace py::literals;

cudaStream_t stream_of(uintptr_t handle) { return reinterpret_cast<cudaStream_t>(handle); }

struct Rows {
    cuda::DeviceRows rows;
    size_t count;
};

// Borrows (means, quats, scales, opacities, sh) on the device.
Rows rows_of(const py::handle& arrays) {
    const py::tuple t = arrays.cast<py::tuple>();
    const py::tuple shape = py::getattr(t[4], "shape").cast<py::tuple>();
    const py::ssize_t bases = shape.size() == 3 ? shape[1].cast<py::ssize_t>() : -1;
    const int degree = degree_of_bases(bases, py::str(shape).cast<std::string>());
    const Span<const float> opacities = device_span_of<const float>(t[3], "opacities", {-1});
    const py::ssize_t n = static_cast<py::ssize_t>(opacities.size);
    const cuda::DeviceRows rows{device_span_of<const float>(t[0], "means", {n, 3}).data,
                                device_span_of<const float>(t[1], "quats", {n, 4}).data,
                                device_span_of<const float>(t[2], "scales", {n, 3}).data,
                                opacities.data,
                                device_span_of<const float>(t[4], "sh", {n, bases, 3}).data,
                                degree};
    for (const float* start : {rows.quats, rows.sh})
        if (reinterpret_cast<uintptr_t>(start) % 16 != 0)
            throw py::value_error("quats, sh: expected memory that begins at a multiple of 16 bytes");
    return {rows, static_cast<size_t>(n)};
}

// Of color (H, W, 3), alpha (H, W) and depth (H, W), on the device.
cuda::FrameImage image_of(const std::array<double, 5>& k, const std::array<double, 3>& background,
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

// A frame in flight and what it reads and writes.
class BoundDrawing {
  public:
    BoundDrawing(py::object frame, py::object arrays, std::unique_ptr<cuda::Drawing> drawing)
        : frame_(std::move(frame)), arrays_(std::move(arrays)), drawing_(std::move(drawing)) {}

    py::dict finish() {
        {
            const py::gil_scoped_release unlocked;
            drawing_->wait();
        }
        const cuda::FrameCounters& c = drawing_->finish();  // which may draw, and so keeps other threads out
        const cuda::FrameTimes times = drawing_->times();
        return py::dict("items"_a = c.items, "gaussians"_a = c.gaussians, "in_frustum"_a = c.in_frustum,
                        "records"_a = c.records, "entries"_a = c.entries, "select_ms"_a = times.prepare_ms,
                        "draw_ms"_a = times.draw_ms);
    }

  private:
    py::object frame_, arrays_;
    std::unique_ptr<cuda::Drawing> drawing_;  // gone before what it reads
};

class BoundScene {
  public:
    BoundScene(const py::list& bundles, const py::list& tables, const py::array& instance_bundle,
               const py::array& positions, const py::array& rotations, const py::array& scales,
               uintptr_t stream)
        : arrays_(bundles) {
        std::vector<cuda::DeviceRows> models;
        std::vector<ClusterTable> cluster_tables;
        std::vector<cuda::ClusterFilters> filters;
        for (size_t b = 0; b < bundles.size(); ++b) {
            const py::tuple t = bundles[b].cast<py::tuple>();
            const Rows rows = rows_of(t[0]);
            const ClusterTable& table = tables[b].cast<const BoundTable&>().table();
            const py::ssize_t clusters = static_cast<py::ssize_t>(table.own_group.size);
            if (table.offset[clusters] > static_cast<int64_t>(rows.count))
                throw py::value_error("offset: expected ranges of the bundle's gaussians");
            models.push_back(rows.rows);
            cluster_tables.push_back(table);
            filters.push_back({span_of<const float>(t[1].cast<py::array>(), "filter_px2", {clusters}),
                               span_of<const uint8_t>(t[2].cast<py::array>(), "antialiased", {clusters})});
        }
        frame_ = std::make_unique<cuda::SceneFrame>(
            Span<const cuda::DeviceRows>{models.data(), models.size()},
            Span<const ClusterTable>{cluster_tables.data(), cluster_tables.size()},
            Span<const cuda::ClusterFilters>{filters.data(), filters.size()},
            instance_table(instance_bundle, positions, rotations, scales, models.size()), stream_of(stream));
    }

    std::unique_ptr<cuda::Drawing> draw(const SelectCamera& camera, const SelectRule& rule,
                                        const cuda::FrameImage& image, uintptr_t stream) {
        return frame_->draw(camera, rule, image, stream_of(stream));
    }

  private:
    py::object arrays_;
    std::unique_ptr<cuda::SceneFrame> frame_;
};

std::unique_ptr<BoundDrawing> draw_scene(const py::object& scene, const py::array& viewmat,
                                         const py::array& eye, const py::array& K, double near,
                                         double tolerance, const std::array<double, 3>& background,
                                         const py::tuple& picture, uintptr_t stream) {
    const Span<const double> k = span_of<const double>(K, "K", {3, 3});
    const cuda::FrameImage image = image_of({k[0], k[4], k[2], k[5], near}, background, picture);
    const SelectCamera camera = select_camera(viewmat, eye, K, image.width, image.height, near);
    return std::make_unique<BoundDrawing>(
        scene, picture,
        scene.cast<BoundScene&>().draw(camera, select_rule(camera, tolerance, "solid_angle", true), image,
                                       stream));
}

std::unique_ptr<BoundDrawing> draw_model(const py::object& frame, const py::tuple& arrays,
                                         const std::array<double, 15>& view, double filter_px2,
                                         bool compensate, const std::array<double, 5>& k,
                                         const std::array<double, 3>& background, const py::tuple& picture,
                                         uintptr_t stream) {
    const Rows rows = rows_of(arrays);
    return std::make_unique<BoundDrawing>(
        frame, py::make_tuple(arrays, picture),
        frame.cast<cuda::ModelFrame&>().draw(rows.rows, rows.count, view_of<float>(view.data()),
                                             static_cast<float>(filter_px2), compensate,
                                             image_of(k, background, picture), stream_of(stream)));
}

}  // namespace

void bind_frame(py::module_& m) {
    py::class_<BoundDrawing>(m, "Drawing", "A frame that has been enqueued on a device.")
        .def("finish", &BoundDrawing::finish,
             "Waits for the picture; what was counted and how long it took.");
    py::class_<BoundScene>(m, "SceneFrame", "Draws a scene that stays on a device.")
        .def(py::init<const py::list&, const py::list&, const py::array&, const py::array&, const py::array&,
                      const py::array&, uintptr_t>(),
             "bundles"_a, "tables"_a, "instance_bundle"_a, "positions"_a, "rotations"_a, "scales"_a,
             "stream"_a)
        .def("draw", &draw_scene, "viewmat"_a, "eye"_a, "K"_a, "near"_a, "tolerance"_a, "background"_a,
             "picture"_a, "stream"_a);
    py::class_<cuda::ModelFrame>(m, "ModelFrame", "Draws all gaussians of arrays on a device.")
        .def(py::init<>())
        .def("draw", &draw_model, "gaussians"_a, "view"_a, "filter_px2"_a, "compensate"_a, "intrinsics"_a,
             "background"_a, "picture"_a, "stream"_a);
}

}  // namespace v3dg

#else

void v3dg::bind_frame(py::module_&) {}

#endif

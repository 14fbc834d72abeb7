#include "bindings/args.h"

#if V3DG_WITH_CUDA

#include <memory>

#include "bindings/frame_args.h"
#include "bindings/select_args.h"
#include "pipeline/scene_frame.h"

namespace v3dg {

namespace {

using namespace py::literals;

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
        std::vector<cuda::PackedModel> models;
        std::vector<ClusterTable> cluster_tables;
        std::vector<cuda::ClusterFilters> filters;
        for (size_t b = 0; b < bundles.size(); ++b) {
            const py::tuple t = bundles[b].cast<py::tuple>();
            const Rows rows = rows_of(t[0]);
            const ClusterTable& table = tables[b].cast<const BoundTable&>().table();
            const py::ssize_t clusters = static_cast<py::ssize_t>(table.own_group.size);
            if (table.offset[clusters] > static_cast<int64_t>(rows.count))
                throw py::value_error("offset: expected ranges of the bundle's gaussians");
            models.emplace_back(rows.rows, rows.count, stream_of(stream));
            cluster_tables.push_back(table);
            filters.push_back({span_of<const float>(t[1].cast<py::array>(), "filter_px2", {clusters}),
                               span_of<const uint8_t>(t[2].cast<py::array>(), "antialiased", {clusters})});
        }
        const InstanceTable instances =
            instance_table(instance_bundle, positions, rotations, scales, models.size());
        frame_ = std::make_unique<cuda::SceneFrame>(
            std::move(models), Span<const ClusterTable>{cluster_tables.data(), cluster_tables.size()},
            Span<const cuda::ClusterFilters>{filters.data(), filters.size()}, instances, stream_of(stream));
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

class BoundModel {
  public:
    BoundModel(const py::tuple& gaussians, uintptr_t stream)
        : BoundModel(gaussians, rows_of(gaussians), stream) {}

    std::unique_ptr<cuda::Drawing> draw(const ModelView<float>& view, double filter_px2, bool compensate,
                                        const cuda::FrameImage& image, uintptr_t stream) {
        return frame_.draw(model_.rows(), model_.size(), view, static_cast<float>(filter_px2), compensate,
                           image, stream_of(stream), &model_.packed());
    }

  private:
    BoundModel(const py::tuple& gaussians, const Rows& rows, uintptr_t stream)
        : arrays_(gaussians), model_(rows.rows, rows.count, stream_of(stream)) {}

    py::object arrays_;
    cuda::PackedModel model_;
    cuda::ModelFrame frame_;
};

std::unique_ptr<BoundDrawing> draw_model(const py::object& frame, const std::array<double, 15>& view,
                                         double filter_px2, bool compensate, const std::array<double, 5>& k,
                                         const std::array<double, 3>& background, const py::tuple& picture,
                                         uintptr_t stream) {
    return std::make_unique<BoundDrawing>(
        frame, picture,
        frame.cast<BoundModel&>().draw(view_of<float>(view.data()), filter_px2, compensate,
                                       image_of(k, background, picture), stream));
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
    py::class_<BoundModel>(m, "ModelFrame", "Draws gaussians that stay on a device.")
        .def(py::init<const py::tuple&, uintptr_t>(), "gaussians"_a, "stream"_a)
        .def("draw", &draw_model, "view"_a, "filter_px2"_a, "compensate"_a, "intrinsics"_a, "background"_a,
             "picture"_a, "stream"_a);
}

}  // namespace v3dg

#else

void v3dg::bind_frame(py::module_&) {}

#endif

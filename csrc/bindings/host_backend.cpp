// The backend of the host, which is always compiled. Arrays are NumPy arrays, there are
// no streams, and all work is finished when a function returns. Its frames and pools
// are in host_frame.cpp.

#include "bindings/backend.h"
#include "bindings/host_frame.h"
#include "bindings/rays.h"
#include "quantize/quantize.h"
#include "residency/host_pages.h"
#include "simplify/simplify.h"

namespace v3dg {

namespace host {

namespace {

// A scene on the host. It has no data, because selection reads the arrays of
// SceneState.
class HostBackendScene final : public backend::Scene {
  public:
    void set_bundles(const SceneState&, const Work&) override {}
    void set_instances(SceneState& state, const Work&) override { read_poses(state); }
    void set_poses(SceneState& state, const Work&) override { read_poses(state); }
    void select(const SceneState& state, const Eyes& eyes, const SelectRule& rule,
                uint32_t* last_bin, const Work&, SelectOutput& out) const override {
        cpu::select({.bundles = {state.tables.data(), state.tables.size()},
                     .instances = state.instances,
                     .eyes = eyes,
                     .rule = rule,
                     .last_bin = last_bin},
                    out);
    }

  private:
    static void read_poses(SceneState& state) {
        InstanceTable& instances = state.instances;
        const auto count = static_cast<py::ssize_t>(instances.bundle.size);
        instances.position = span_of<const double>(state.arrays[2], "positions", {count, 3});
        instances.quaternion = span_of<const double>(state.arrays[3], "quaternions", {count, 4});
        instances.scale = span_of<const double>(state.arrays[4], "scales", {count});
    }
};

class HostTarget final : public backend::Target {
  public:
    HostTarget(const GaussianRows<const float>& rows, float filter_px2, bool antialiased)
        : filter_px2_(filter_px2), antialiased_(antialiased) {
        const Unlocked unlocked;
        model_ = std::make_unique<::v3dg::Model<float>>(rows);
    }

    void fit_level(const FitConfig& config, Span<const FitGroup> groups,
                   const GaussianRows<float>& gaussians, float* error, FitProgress& progress,
                   const Work&) const override {
        v3dg::fit_level(config, groups, target(), gaussians, error, progress);
    }
    void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                     const CutRows& levels, const CutPictures& pictures, FitProgress& progress,
                     const Work&) const override {
        v3dg::refine_cuts(config, comparison, target(), model_->size(), levels, pictures, progress);
    }

  private:
    FitTarget target() const { return {&model_->planes(), filter_px2_, antialiased_}; }

    float filter_px2_;
    bool antialiased_;
    std::unique_ptr<::v3dg::Model<float>> model_;
};

// row_alignment is 1, because processors that run Python can read float32 from any
// address.
constexpr BackendTraits kTraits{.host_reads_arrays = true,
                                .computes_doubles = true,
                                .row_alignment = 1,
                                .draws_only_plainly = false};

class HostBackend final : public Backend {
  public:
    HostBackend() : Backend(kTraits) {}

    int num_devices() const override { return 1; }
    std::optional<Device> device_of(const py::handle& array) const override {
        if (!py::isinstance<py::array>(array)) return {};
        return kHost;
    }
    Borrowed borrow(Device, const py::handle& array, const char* name, const Element& element,
                    const Shape& shape, bool is_written) const override {
        return borrow_on_host(array, name, element, shape, is_written);
    }
    MadeArray make_array(Device, const Element& element,
                         const std::vector<py::ssize_t>& shape) const override {
        py::array array(element.dtype(), shape);
        void* const data = array.mutable_data();
        return {.object = std::move(array), .data = data};
    }
    py::object to_host(const py::object& array) const override { return array; }
    py::object from_host(const py::object& array, Device) const override { return array; }

    Entered enter(Device) const override { return {.device_before = 0, .stream = nullptr}; }
    void leave(Device, int) const noexcept override {}

    void median_split(Span<const Point> points, Span<const int64_t> offset, int depth, size_t unit,
                      Span<int64_t> order, Span<int64_t> leaf_offset, const Work&) const override {
        cpu::median_split(points, offset, depth, unit, order, leaf_offset);
    }
    void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                       Span<Ball> out, const Work&) const override {
        cpu::bound_spheres(spheres, offset, margin, out);
    }
    void bound_by_boxes(const BoxInput& in, Span<Box> out, const Work&) const override {
        cpu::bound_by_boxes(in, out);
    }
    void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
               Span<const int64_t> out_offset, Span<int64_t> kept, const Work&) const override {
        cpu::prune(in, in_offset, out_offset, kept);
    }
    void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
               Span<const int64_t> out_offset, const GaussianRows<float>& out,
               const Work&) const override {
        cpu::merge(in, in_offset, out_offset, out);
    }
    void gather(const GatherInput& in, const GaussianRows<float>& out, const Work&) const override {
        cpu::gather(in, out);
    }
    void ellipses(const EllipsesInput<float>& in, const Ellipses<float>& out,
                  const Work&) const override {
        cpu::ellipses(in, out);
    }
    void ellipses(const EllipsesInput<double>& in, const Ellipses<double>& out,
                  const Work&) const override {
        cpu::ellipses(in, out);
    }
    void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& gaussians,
                    const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress,
                    const Work&) const override {
        v3dg::weigh_cuts(config, gaussians, pictures, seen, progress);
    }

    // Returns null, because selection on the host reads the original tables.
    std::shared_ptr<const backend::Tables> make_tables(const BoundTable&,
                                                       const Work&) const override {
        return nullptr;
    }
    std::shared_ptr<const backend::Model> make_model(const Rows& rows, const Work&) const override {
        return std::make_shared<HostModel>(rows.read<float>());
    }
    std::shared_ptr<const backend::Model> make_model(const py::object& codes,
                                                     const Work&) const override {
        return std::make_shared<HostModel>(codes);
    }
    std::shared_ptr<const backend::Palette> make_palette(const py::object& table,
                                                         const py::array& sh,
                                                         const Work&) const override {
        return std::make_shared<HostPalette>(table, sh);
    }
    std::unique_ptr<backend::Scene> make_scene(const Work&) const override {
        return std::make_unique<HostBackendScene>();
    }
    PoolDemands pool_demands(int max_sh_degree) const override {
        // The host uses 32-bit indices for SH codes, separately for each degree.
        const size_t most_coded_rows = UINT32_MAX / static_cast<size_t>(std::max(1, max_sh_degree));
        return {.most_block_bytes = size_t(64) << 20,
                .row_bytes = sizeof(float) * (11 + 3 * num_sh_bases(max_sh_degree)),
                .most_coded_rows = most_coded_rows,
                .most_frames = 1,
                .blocks = std::make_shared<HostBlocks>()};
    }
    std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list&,
                                             const Work&) const override {
        return host::make_pool(pool);
    }
    std::unique_ptr<backend::Frame> make_frame(const Work&) const override {
        return host::make_frame();
    }
    std::unique_ptr<backend::AssetFrame> make_asset_frame(
        std::shared_ptr<const backend::Model> model, Appearance<float> appearance,
        const Work&) const override {
        return host::make_asset_frame(std::move(model), appearance);
    }
    std::unique_ptr<backend::RayFrame> make_ray_frame(const Work&) const override {
        return host::make_ray_frame();
    }
    std::unique_ptr<backend::Target> make_target(const Rows& rows, float filter_px2,
                                                 bool antialiased) const override {
        return std::make_unique<HostTarget>(rows.read<float>(), filter_px2, antialiased);
    }

    Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                         bool with_depth, bool keep_tape) const override {
        return host::rasterize(gaussians, camera, look, with_depth, keep_tape);
    }
    RasterizedViews rasterize_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                    const ViewsLook& look, bool with_depth,
                                    bool keep_tape) const override {
        return host::rasterize_views(gaussians, cameras, look, with_depth, keep_tape);
    }
};

}  // namespace
}  // namespace host

// The backend is never destroyed, because Python may end before the process.
const Backend& host_backend() {
    static const Backend& backend = *new host::HostBackend;
    return backend;
}

}  // namespace v3dg

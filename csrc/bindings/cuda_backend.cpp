// The backend of CUDA devices, compiled only with CUDA. It accepts arrays with
// __cuda_array_interface__, returns new arrays as torch tensors, and enqueues work on
// torch's current stream. Its frames and pools are in cuda_frame.cpp.

#include <pybind11/gil_safe_call_once.h>

#include "base/device_guard.h"
#include "bindings/backend.h"
#include "bindings/cuda_frame.h"
#include "bindings/rays.h"
#include "levels/fit_level_cuda.h"
#include "levels/refine_cuts_cuda.h"
#include "simplify/simplify.h"

namespace v3dg {

namespace cuda {

Borrowed borrow_anywhere(const py::handle& array, const char* name, const Element& element,
                         const Shape& shape) {
    const py::object found = cuda_interface_of(array);
    if (found.is_none()) refuse_kind(name, "an array on a CUDA device", array);
    const py::dict face(found);
    const std::string dtype = face["typestr"].cast<std::string>();
    if (dtype != element.typestr)
        refuse_value(name, std::string("expected dtype ") + element.typestr + ", got " + dtype);
    const auto lengths = face["shape"].cast<py::tuple>().cast<std::vector<py::ssize_t>>();
    if (!fits_shape(lengths, shape))
        refuse_value(name, "expected shape " + shape_text(shape) + ", got " +
                               py::str(face["shape"]).cast<std::string>());
    if (face.contains("strides") && !face["strides"].is_none())
        refuse_value(name, "expected a contiguous array, got a strided one");
    size_t size = 1;
    for (const py::ssize_t length : lengths) size *= static_cast<size_t>(length);
    const auto address = face["data"].cast<py::tuple>()[0].cast<uintptr_t>();
    return {.data = reinterpret_cast<void*>(address), .size = size};
}

namespace {

// The functions of torch that every frame needs. They are looked up only once. The
// object is never destroyed, because Python may end before the process.
struct Torch {
    // current_stream returns the stream as an integer
    py::object empty, current_stream;

    static const Torch& get() {
        PYBIND11_CONSTINIT static py::gil_safe_call_once_and_store<Torch> known;
        return known.call_once_and_store_result([] { return Torch(); }).get_stored();
    }

    const py::object& dtype(const Element& element) const {
        const char kind = element.typestr[1];
        const char size = element.typestr[2];
        if (kind == 'f') return float32_;
        return size == '8' ? int64_ : size == '4' ? int32_ : uint8_;
    }

  private:
    Torch()
        : empty(py::module_::import("torch").attr("empty")),
          current_stream(initialised_cuda().attr("_C").attr("_cuda_getCurrentRawStream")),
          float32_(py::module_::import("torch").attr("float32")),
          int64_(py::module_::import("torch").attr("int64")),
          int32_(py::module_::import("torch").attr("int32")),
          uint8_(py::module_::import("torch").attr("uint8")) {}

    // Returns the module torch after initialising CUDA. Used by callers that do not
    // initialise CUDA in another way.
    static py::module_ initialised_cuda() {
        py::module_::import("torch.cuda").attr("init")();
        return py::module_::import("torch");
    }

    py::object float32_, int64_, int32_, uint8_;
};

// Throws ValueError if the memory is on another CUDA device.
void check_is_on(Device device, const void* memory, const char* name) {
    cudaPointerAttributes attributes{};
    if (cudaPointerGetAttributes(&attributes, memory) != cudaSuccess)
        cudaGetLastError();
    else if (attributes.type == cudaMemoryTypeDevice && attributes.device != device.number)
        refuse_value(name,
                     "expected an array on cuda:" + std::to_string(device.number) +
                         " like the others, got one on cuda:" + std::to_string(attributes.device));
}

class BackendTarget final : public backend::Target {
  public:
    BackendTarget(const Rows& rows, float filter_px2, bool antialiased)
        : rows_(rows), filter_px2_(filter_px2), antialiased_(antialiased) {}

    void fit_level(const FitConfig& config, Span<const FitGroup> groups,
                   const GaussianRows<float>& gaussians, float* error, FitProgress& progress,
                   const Work& work) const override {
        cuda::fit_level(config, groups, target(), gaussians, error, progress, stream_of(work));
    }
    void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                     const CutRows& levels, const CutPictures& pictures, FitProgress& progress,
                     const Work& work) const override {
        cuda::refine_cuts(config, comparison, target(), levels, pictures, progress,
                          stream_of(work));
    }

  private:
    DeviceFitTarget target() const { return {rows_.read<float>(), filter_px2_, antialiased_}; }

    Rows rows_;
    float filter_px2_;
    bool antialiased_;
};

// row_alignment is 16, because kernels read four floats at once.
constexpr BackendTraits kTraits{.host_reads_arrays = false,
                                .computes_doubles = false,
                                .row_alignment = 16,
                                .draws_only_plainly = true};

class CudaBackend final : public Backend {
  public:
    CudaBackend() : Backend(kTraits) {}

    int num_devices() const override { return cuda::num_devices(); }

    std::optional<Device> device_of(const py::handle& array) const override {
        const py::object face = cuda_interface_of(array);
        if (face.is_none()) return {};
        const auto pointer = py::dict(face)["data"].cast<py::tuple>()[0].cast<uintptr_t>();
        cudaPointerAttributes attributes{};
        if (pointer != 0 &&
            cudaPointerGetAttributes(&attributes, reinterpret_cast<const void*>(pointer)) ==
                cudaSuccess &&
            attributes.type == cudaMemoryTypeDevice)
            return Device{attributes.device};
        cudaGetLastError();
        // An array without elements has no memory, and thus no device. A torch tensor
        // still has the name of its device. Any other array counts as being on the
        // current device.
        const py::object index =
            py::getattr(py::getattr(array, "device", py::none()), "index", py::none());
        if (py::isinstance<py::int_>(index)) return Device{index.cast<int>()};
        int current = 0;
        if (cudaGetDevice(&current) != cudaSuccess) cudaGetLastError();
        return Device{current};
    }

    Borrowed borrow(Device device, const py::handle& array, const char* name,
                    const Element& element, const Shape& shape, bool) const override {
        const Borrowed borrowed = borrow_anywhere(array, name, element, shape);
        check_is_on(device, borrowed.data, name);
        return borrowed;
    }

    MadeArray make_array(Device device, const Element& element,
                         const std::vector<py::ssize_t>& shape) const override {
        const Torch& torch = Torch::get();
        try {
            py::object array =
                torch.empty(py::tuple(py::cast(shape)), "dtype"_a = torch.dtype(element),
                            "device"_a = device.number);
            const auto address = array.attr("data_ptr")().cast<uintptr_t>();
            return {.object = std::move(array), .data = reinterpret_cast<void*>(address)};
        } catch (py::error_already_set& error) {
            const py::str kind(error.type().attr("__name__"));
            if (kind.cast<std::string>() != "OutOfMemoryError") throw;
            PyErr_SetString(PyExc_MemoryError, py::str(error.value()).cast<std::string>().c_str());
            throw py::error_already_set();
        }
    }

    py::object to_host(const py::object& array) const override {
        return array.attr("detach")().attr("cpu")().attr("numpy")();
    }
    py::object from_host(const py::object& array, Device device) const override {
        return py::module_::import("torch").attr("as_tensor")(array, "device"_a = device.number);
    }

    Entered enter(Device device) const override {
        const int before = current_device();
        if (device.number != before) check(cudaSetDevice(device.number), "cudaSetDevice");
        try {
            const py::object stream = Torch::get().current_stream(device.number);
            return {.device_before = before,
                    .stream = reinterpret_cast<void*>(stream.cast<uintptr_t>())};
        } catch (...) {
            leave(device, before);
            throw;
        }
    }
    void leave(Device device, int device_before) const noexcept override {
        if (device.number != device_before && cudaSetDevice(device_before) != cudaSuccess)
            cudaGetLastError();
    }

    void median_split(Span<const Point> points, Span<const int64_t> offset, int depth, size_t unit,
                      Span<int64_t> order, Span<int64_t> leaf_offset,
                      const Work& work) const override {
        cuda::median_split(points, offset, depth, unit, order, leaf_offset, stream_of(work));
    }
    void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                       Span<Ball> out, const Work& work) const override {
        cuda::bound_spheres(spheres, offset, margin, out, stream_of(work));
    }
    void bound_by_boxes(const BoxInput& in, Span<Box> out, const Work& work) const override {
        cuda::bound_by_boxes(in, out, stream_of(work));
    }
    void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
               Span<const int64_t> out_offset, Span<int64_t> kept,
               const Work& work) const override {
        cuda::prune(in, in_offset, out_offset, kept, stream_of(work));
    }
    void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
               Span<const int64_t> out_offset, const GaussianRows<float>& out,
               const Work& work) const override {
        cuda::merge(in, in_offset, out_offset, out, stream_of(work));
    }
    void gather(const GatherInput& in, const GaussianRows<float>& out,
                const Work& work) const override {
        cuda::gather(in, out, stream_of(work));
    }
    void ellipses(const EllipsesInput<float>& in, const Ellipses<float>& out,
                  const Work& work) const override {
        cuda::ellipses(in, out, stream_of(work));
    }
    void ellipses(const EllipsesInput<double>&, const Ellipses<double>&,
                  const Work&) const override {
        throw std::invalid_argument("gaussians: float64 is supported only on the CPU; use float32");
    }
    void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& gaussians,
                    const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress,
                    const Work& work) const override {
        cuda::weigh_cuts(config, gaussians, pictures, seen, progress, stream_of(work));
    }

    std::shared_ptr<const backend::Tables> make_tables(const BoundTable& table,
                                                       const Work& work) const override {
        return std::make_shared<BackendTables>(table, work);
    }
    std::shared_ptr<const backend::Model> make_model(const Rows& rows,
                                                     const Work& work) const override {
        return cuda::make_model(rows, work);
    }
    std::shared_ptr<const backend::Model> make_model(const py::object& codes,
                                                     const Work& work) const override {
        return cuda::make_model(codes, work);
    }
    std::shared_ptr<const backend::Palette> make_palette(const py::object& table,
                                                         const py::array& sh,
                                                         const Work& work) const override {
        return cuda::make_palette(table, sh, work);
    }
    std::unique_ptr<backend::Scene> make_scene(const Work&) const override {
        return cuda::make_scene();
    }
    PoolDemands pool_demands(int max_sh_degree) const override {
        return {.most_block_bytes = size_t(128) << 20,
                .row_bytes = packed_row_bytes(max_sh_degree),
                .most_coded_rows = 0,
                .most_frames = kMostFlights,
                .blocks = std::make_shared<PinnedBlocks>()};
    }
    std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list& tables,
                                             const Work& work) const override {
        return cuda::make_pool(pool, tables, work);
    }
    std::unique_ptr<backend::Frame> make_frame(const Work& work) const override {
        return cuda::make_frame(work);
    }
    std::unique_ptr<backend::AssetFrame> make_asset_frame(
        std::shared_ptr<const backend::Model> model, Appearance<float> appearance,
        const Work& work) const override {
        return cuda::make_asset_frame(std::move(model), appearance, work);
    }
    std::unique_ptr<backend::RayFrame> make_ray_frame(const Work&) const override {
        return cuda::make_ray_frame();
    }
    std::unique_ptr<backend::Target> make_target(const Rows& rows, float filter_px2,
                                                 bool antialiased) const override {
        return std::make_unique<BackendTarget>(rows, filter_px2, antialiased);
    }

    Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                         bool with_depth, bool keep_tape) const override {
        return cuda::rasterize(gaussians, camera, look, with_depth, keep_tape);
    }
    RasterizedViews rasterize_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                    const ViewsLook& look, bool with_depth,
                                    bool keep_tape) const override {
        return cuda::rasterize_views(gaussians, cameras, look, with_depth, keep_tape);
    }
};

}  // namespace
}  // namespace cuda

// The backend is never destroyed, because Python may end before the process.
const Backend& cuda_backend() {
    static const Backend& backend = *new cuda::CudaBackend;
    return backend;
}

}  // namespace v3dg

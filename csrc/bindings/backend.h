#pragma once

// The interface between the bindings and the code that computes. A Backend is the host,
// or one kind of device. The bindings check the arguments from Python, then call the
// backend that backend_of() returns. Bound classes hold handles that a backend has made
// (namespace backend). Only the source files of a backend depend on its kind of device.
//
// To add a backend (WebGPU, HIP, Metal):
// 1. Write `<name>_backend.cpp` beside this header: a class that is derived from
//    Backend, and one derived class for each handle of the namespace backend. Start
//    from host_backend.cpp and host_frame.cpp, which need no device. cuda_backend.cpp
//    and cuda_frame.cpp show what is different on a device.
// 2. List the source files in CMakeLists.txt, as V3DG_CUDA_BINDINGS does, so that they
//    are compiled only if the device's compiler is found.
// 3. Return the backend from device_backend() in backend.cpp, which contains the only
//    `#if` of the bindings. A module has the host and at most one kind of device. For
//    two kinds, add a kind to `Device` (base/dispatch.h), and make backend_of() use it.
// 4. Make `v3dg/_device.py` find the devices. The fixture `device` then runs the tests
//    of each operation on them. STYLE.md says how closely results must agree: decisions
//    have equal bits, floats are within bounds.
//
// A backend supplies, in the order of this file: arrays, work, operations, handles,
// drawing, and fits. The comment of each function is its contract. The following holds
// for all of them.
//
// GIL: the GIL (Python's global interpreter lock) is held when a function is called,
// unless the function is in the part "without the GIL", or its comment says so. A
// function that computes or waits for long releases the GIL meanwhile (Unlocked).
// Streams: work is enqueued on `Work::stream()`, the caller's stream. The caller never
// has to wait for another stream. Memory from Python may be reused on that stream as
// soon as the function returns. Waiting: a function returns when its work is enqueued.
// If its comment says "Waits", the results are in host memory when it returns.
// Ownership: bound objects own the handles, and destroy them with the GIL held. A
// handle that borrows from a Python object keeps a reference to the object. Spans are
// valid until the function returns. Spans of device memory are valid until the enqueued
// work is done, because torch frees memory in stream order. Errors: a backend does not
// repeat the checks of the bindings. std::bad_alloc becomes a MemoryError,
// std::invalid_argument and py::value_error become a ValueError, and std::runtime_error
// becomes a RuntimeError.

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "bindings/batch.h"
#include "bindings/codes.h"
#include "bindings/drawing.h"
#include "bindings/tape.h"
#include "bindings/types.h"
#include "bindings/views.h"
#include "cluster/box.h"
#include "cluster/cluster.h"
#include "draw/request.h"
#include "frame/draw_list.h"
#include "gather/gather.h"
#include "levels/fit_level.h"
#include "levels/refine_cuts.h"
#include "project/ellipses.h"
#include "residency/page_pool.h"
#include "select/budget_steps.h"

namespace v3dg {

constexpr const char* kWithoutCuda =
    "v3dg was built without CUDA; install it again where nvcc is found";

class BoundTable;
struct SceneState;

// The result of Backend::enter().
struct Entered {
    int device_before;  // leave() makes this device current again
    void* stream;
};

// The capabilities of a backend.
struct BackendTraits {
    // The host can read the arrays, so the bindings check their values.
    bool host_reads_arrays;
    bool computes_doubles;  // can draw and differentiate float64 gaussians
    size_t row_alignment;   // alignment of quaternions and SH coefficients, bytes
    // Supports only plain requests (FrameRequest::is_plain), and no picking.
    bool draws_only_plainly;
};

// The requirements of a device on a page pool.
struct PoolDemands {
    // The most bytes of pages that are copied while a few frames are drawn.
    size_t most_block_bytes;
    size_t row_bytes;  // bytes per gaussian of a page that is stored as rows
    // The most gaussians that can be stored as codes. 0: only PoolMemory limits them.
    size_t most_coded_rows;
    size_t most_frames;  // the most frames whose cuts are in progress
    std::shared_ptr<BlockMemory> blocks;
};

namespace backend {

// The tables of one bundle on a device, for selection and drawing. All scenes on the
// device share them.
class Tables {
  public:
    virtual ~Tables() = default;
    virtual size_t bytes() const = 0;
};

// The gaussians of one bundle or asset, in the layout that frames read.
class Model {
  public:
    virtual ~Model() = default;
    // Returns the memory in bytes, without the arrays that the model was made from.
    virtual size_t bytes() const = 0;
    // Decodes the gaussians of `clusters`. The model must be coded. The gaussians of
    // clusters[k] are written from row offset[k] on. Called without the GIL.
    virtual void decode(Span<const int32_t> clusters, Span<const int64_t> offset, const Work& work,
                        const GaussianRows<float>& out) const = 0;
};

// The colours of a bundle's clusters.
class Palette {
  public:
    virtual ~Palette() = default;
};

// The part of a scene that selection reads, on a device. The parameter `state` is the
// same scene on the host.
class Scene {
  public:
    virtual ~Scene() = default;
    // Replaces all bundles. The caller then calls set_instances().
    virtual void set_bundles(const SceneState& state, const Work& work) = 0;
    // Sets the instances and their poses from `state.arrays`. If the host can read
    // arrays of this backend, it also copies the poses to `state.instances`. Throws
    // ValueError or TypeError if an array is wrong, and then changes nothing.
    virtual void set_instances(SceneState& state, const Work& work) = 0;
    // Like set_instances(), but only the poses have changed.
    virtual void set_poses(SceneState& state, const Work& work) = 0;
    // Selects a cut. Waits. See SelectInput for `last_bin`. Called without the GIL, by
    // one thread at a time.
    virtual void select(const SceneState& state, const Eyes& eyes, const SelectRule& rule,
                        uint32_t* last_bin, const Work& work, SelectOutput& out) const = 0;
};

// The slots of a page pool on a device. The PagePool that it was made from must outlive
// it.
class Pool {
  public:
    virtual ~Pool() = default;
    // Makes one step towards a state in which all pages of a view are resident. It
    // brings in all pages that were read, selects the cut, draws nothing, and waits
    // until the pool has decided about the pages that the cut needs. `begins` marks the
    // first step, which discards the requests of earlier frames
    // (PagePool::begin_settling). Called without the GIL.
    virtual SettlingStep settle_step(const Scene& scene, const SceneState& state, const Eyes& eyes,
                                     const SelectRule& rule, bool begins, const Work& work) = 0;
};

// The inputs of a frame. The bindings have checked that they fit each other and the
// frame's models.
struct FrameInput {
    const FrameRequest& request;
    const Scene& scene;
    std::shared_ptr<const SceneState> state;
    Pool* pool;  // null: draw the frame's own models
    // The state of a sequence of pictures; null for a single picture.
    BudgetSteps* steps;
    // A flag that asks to end the picture early, if possible. May be null.
    const std::atomic<bool>* stop;
};

// The inputs of a batch. The bindings check them like the inputs of a picture.
struct BatchInput {
    const BatchRequest& request;
    const BoundCameras& cameras;
    const Scene& scene;
    std::shared_ptr<const SceneState> state;
};

// Draws scenes of the same bundles.
class Frame {
  public:
    virtual ~Frame() = default;
    // Sets the model of each bundle and, unless `palettes` is empty, its palette. The
    // frame shares ownership of them.
    virtual void set_models(std::vector<std::shared_ptr<const Model>> models,
                            std::vector<std::shared_ptr<const Palette>> palettes,
                            const Work& work) = 0;
    // Draws a frame. If the drawing is unfinished on return, it keeps the frame, the
    // scene, the pool and the request alive (BoundDrawing::keep); they do not change
    // before it is finished or destroyed. A backend whose frames share buffers uses a
    // Turn. A request with a given cut has one eye.
    virtual std::unique_ptr<BoundDrawing> draw(const FrameInput& input) = 0;
    // Draws a batch of pictures with the frame's own models. Like draw(), but the
    // caller owns the planes, which exist until the drawing is finished. A batch that
    // does not fit into memory is drawn in parts.
    virtual std::unique_ptr<BoundBatch> draw_batch(const BatchInput& input) = 0;
    // Finds the gaussian with the largest blend weight in the first pixel of the
    // window. Returns false if no gaussian is drawn there. Waits. Called only if
    // draws_only_plainly is false.
    virtual bool pick(const FrameInput& input, ScenePick& picked) = 0;
    // Returns the device memory of the frame in bytes, by part, and the bytes of the
    // memory pool, from which all parts but the large buffers of a frame are allocated.
    virtual std::vector<std::pair<const char*, size_t>> memory() const = 0;
};

// Draws all gaussians of one model of rows.
class AssetFrame {
  public:
    virtual ~AssetFrame() = default;
    // Like Frame::draw(), for one camera.
    virtual std::unique_ptr<BoundDrawing> draw(const Camera& camera, const Shade& shade,
                                               const SensorRequest& sensor,
                                               const std::atomic<bool>* stop) = 0;
};

// The gaussians that groups or cuts are fitted to. All functions wait, and check
// FitProgress::cancel now and then. Called without the GIL.
class Target {
  public:
    virtual ~Target() = default;
    // Fits groups of one level (levels/fit_level.h). `error` is in host memory.
    virtual void fit_level(const FitConfig& config, Span<const FitGroup> groups,
                           const GaussianRows<float>& gaussians, float* error,
                           FitProgress& progress, const Work& work) const = 0;
    // Refines all levels together (levels/refine_cuts.h).
    virtual void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                             const CutRows& levels, const CutPictures& pictures,
                             FitProgress& progress, const Work& work) const = 0;
};

// Casts the rays of sensors (bindings/rays.h).
class RayFrame;

}  // namespace backend

class Backend {
  public:
    explicit Backend(const BackendTraits& traits) : traits(traits) {}
    virtual ~Backend() = default;
    Backend(const Backend&) = delete;
    Backend& operator=(const Backend&) = delete;

    const BackendTraits traits;

    // ---- arrays

    // Returns the number of devices.
    virtual int num_devices() const = 0;
    // Returns the device of an array, or nullopt if this backend does not accept the
    // array.
    virtual std::optional<Device> device_of(const py::handle& array) const = 0;
    // Borrows an array after checks of its kind, dtype, shape, layout and device.
    virtual Borrowed borrow(Device device, const py::handle& array, const char* name,
                            const Element& element, const Shape& shape, bool is_written) const = 0;
    // Returns a new, uninitialised array.
    virtual MadeArray make_array(Device device, const Element& element,
                                 const std::vector<py::ssize_t>& shape) const = 0;
    // Returns a copy of the array as a NumPy array. Waits.
    virtual py::object to_host(const py::object& array) const = 0;
    // Returns a copy of a NumPy array on the device.
    virtual py::object from_host(const py::object& array, Device device) const = 0;

    // ---- work

    // Makes a device current in this thread, and returns torch's current stream on it.
    virtual Entered enter(Device device) const = 0;
    virtual void leave(Device device, int device_before) const noexcept = 0;

    // ---- operations without the GIL; see their headers

    // Waits, because `leaf_offset` is in host memory.
    virtual void median_split(Span<const Point> points, Span<const int64_t> offset, int depth,
                              size_t unit, Span<int64_t> order, Span<int64_t> leaf_offset,
                              const Work& work) const = 0;
    virtual void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                               Span<Ball> out, const Work& work) const = 0;
    virtual void bound_by_boxes(const BoxInput& in, Span<Box> out, const Work& work) const = 0;
    virtual void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
                       Span<const int64_t> out_offset, Span<int64_t> kept,
                       const Work& work) const = 0;
    virtual void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
                       Span<const int64_t> out_offset, const GaussianRows<float>& out,
                       const Work& work) const = 0;
    virtual void gather(const GatherInput& in, const GaussianRows<float>& out,
                        const Work& work) const = 0;
    virtual void ellipses(const EllipsesInput<float>& in, const Ellipses<float>& out,
                          const Work& work) const = 0;
    // The version for float64. Called only if computes_doubles is true.
    virtual void ellipses(const EllipsesInput<double>& in, const Ellipses<double>& out,
                          const Work& work) const = 0;
    // Waits, because the sums are in host memory.
    virtual void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& gaussians,
                            const CutPictures& pictures, const SeenOfGaussians& seen,
                            FitProgress& progress, const Work& work) const = 0;

    // ---- handles

    virtual std::shared_ptr<const backend::Tables> make_tables(const BoundTable& table,
                                                               const Work& work) const = 0;
    // Return a model of float32 rows, or of codes (BoundCodes). The model borrows the
    // arrays and keeps them alive.
    virtual std::shared_ptr<const backend::Model> make_model(const Rows& rows,
                                                             const Work& work) const = 0;
    virtual std::shared_ptr<const backend::Model> make_model(const py::object& codes,
                                                             const Work& work) const = 0;
    // Returns a palette. `table` is a ClusterTable; `sh` is (C, 3), the SH coefficients
    // of degree 0 of its clusters.
    virtual std::shared_ptr<const backend::Palette> make_palette(const py::object& table,
                                                                 const py::array& sh,
                                                                 const Work& work) const = 0;
    virtual std::unique_ptr<backend::Scene> make_scene(const Work& work) const = 0;
    virtual PoolDemands pool_demands(int max_sh_degree) const = 0;
    // Returns a pool. `tables` are ClusterTables, in the order of the pool's bundles.
    virtual std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list& tables,
                                                     const Work& work) const = 0;
    virtual std::unique_ptr<backend::Frame> make_frame(const Work& work) const = 0;
    virtual std::unique_ptr<backend::AssetFrame> make_asset_frame(
        std::shared_ptr<const backend::Model> model, Appearance<float> appearance,
        const Work& work) const = 0;
    virtual std::unique_ptr<backend::RayFrame> make_ray_frame(const Work& work) const = 0;
    virtual std::unique_ptr<backend::Target> make_target(const Rows& rows, float filter_px2,
                                                         bool antialiased) const = 0;

    // ---- gradients

    // Draws gaussians without levels. If `keep_tape`, the result has a tape, which
    // keeps the gaussians alive.
    virtual Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera,
                                 const DrawLook& look, bool with_depth, bool keep_tape) const = 0;
    // Draws gaussians without levels for several pinholes of one size, whose arrays are
    // on the host. `gaussians` are those of all views, or of each view. Otherwise like
    // rasterize().
    virtual RasterizedViews rasterize_views(const std::vector<Rows>& gaussians,
                                            const BoundCameras& cameras, const ViewsLook& look,
                                            bool with_depth, bool keep_tape) const = 0;
};

// Returns the backend of a device. Throws RuntimeError if it was not compiled.
const Backend& backend_of(Device device);

// Return the backend of the host and the backend of devices. The backend of devices is
// null if none was compiled.
const Backend& host_backend();
const Backend* device_backend();

// Returns the backend of CUDA devices (cuda_backend.cpp). Defined only if CUDA was
// compiled.
const Backend& cuda_backend();

// Throws ValueError with the text "name: problem" unless the device is the host.
void check_is_on_host(Device device, const char* name, const char* problem);

}  // namespace v3dg

#pragma once

// The interface between the bindings and the code that computes: a Backend is the host,
// or one kind of device. The bindings check the arguments from Python and call the
// backend that backend_of() returns. Bound classes hold handles that the backend made
// (namespace backend). Only the sources of a backend depend on its kind of device.
//
// To add a backend (WebGPU, HIP, Metal):
// 1. Write `<name>_backend.cpp` beside this header, with a class derived from Backend,
// and one derived from each handle of the namespace backend. Start from
// host_backend.cpp and host_frame.cpp, which need no device; cuda_backend.cpp and
// cuda_frame.cpp show what differs on a device.
// 2. List its sources in CMakeLists.txt, as V3DG_CUDA_BINDINGS does, so that they are
// compiled only if the device's compiler is found.
// 3. Return it from device_backend() in backend.cpp, which contains the only `#if` of
// the bindings. A module has the host and at most one kind of device; for two kinds,
// add a kind to `Device` (base/dispatch.h), and let backend_of() read it.
// 4. Let `v3dg/_device.py` find its devices. The tests of an operation then run on them
// through the fixture `device`; STYLE.md says how results must agree: decisions bit by
// bit, floats within bounds.
//
// A backend supplies, in this order: arrays, work, operations, handles, drawing, fits.
// Each function below has its own contract.
//
// Python's lock: a function is called with it, unless it is in the part "without
// Python's lock" or its comment says so. A function that works or waits for long
// releases it meanwhile (Unlocked).
// Streams: work is queued on `Work::stream()`, the caller's stream, and on no other
// stream that the caller would have to wait for. Memory that Python gave may be reused
// on that stream on return.
// Waiting: a function returns when its work is queued. If its comment says "Waits",
// results are on the host on return.
// Ownership: bound objects own the handles, which are destroyed with Python's lock
// held. A handle that borrows from a Python object keeps a reference to it. Spans are
// valid until the function returns; those of arrays on the device are valid until the
// queued work is done, because torch frees that memory in stream order.
// Errors: a backend does not repeat the checks of the bindings. std::bad_alloc becomes
// a MemoryError, std::invalid_argument and py::value_error a ValueError,
// std::runtime_error a RuntimeError.

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
    int device_before;  // leave() makes it the current one again
    void* stream;
};

// The abilities of a backend.
struct BackendTraits {
    bool host_reads_arrays;   // if so, the bindings check values
    bool computes_doubles;    // float64 gaussians are drawn and differentiated
    size_t row_alignment;     // of quaternions and coefficients, bytes
    bool draws_only_plainly;  // requests are plain (FrameRequest::is_plain), and nothing is picked
};

// The memory of a device that a pool needs.
struct PoolDemands {
    // Limit on the bytes of pages in transfer while a few frames are drawn.
    size_t most_block_bytes;
    size_t row_bytes;  // bytes of a gaussian whose page is stored as rows
    // Limit on the gaussians whose pages are stored as codes; 0: only PoolMemory limits
    // them.
    size_t most_coded_rows;
    size_t most_frames;  // limit on the frames whose cuts are unfinished
    std::shared_ptr<BlockMemory> blocks;
};

namespace backend {

// The tables of one bundle on a device, which selection and drawing read. All scenes of
// the device share them.
class Tables {
  public:
    virtual ~Tables() = default;
    virtual size_t bytes() const = 0;
};

// The gaussians of one bundle or asset, in the layout that frames read.
class Model {
  public:
    virtual ~Model() = default;
    // Returns the bytes of memory beside the arrays that the model was made of.
    virtual size_t bytes() const = 0;
    // Decodes the gaussians of clusters of a model of codes; those of cluster k begin
    // at offset[k]. Called without Python's lock.
    virtual void decode(Span<const int32_t> clusters, Span<const int64_t> offset, const Work& work,
                        const GaussianRows<float>& out) const = 0;
};

// The colours of a bundle's clusters.
class Palette {
  public:
    virtual ~Palette() = default;
};

// The part of a scene that selection reads, on the backend's device. `state` is the
// scene on the host.
class Scene {
  public:
    virtual ~Scene() = default;
    // Replaces all bundles. The caller calls set_instances() next.
    virtual void set_bundles(const SceneState& state, const Work& work) = 0;
    // Sets the instances and poses to those in `state.arrays`. If the host reads the
    // backend's arrays, it also copies the poses into `state.instances`. Throws
    // ValueError or TypeError, without changing anything, if an array of poses is
    // wrong.
    virtual void set_instances(SceneState& state, const Work& work) = 0;
    // As set_instances(), if only the poses have changed.
    virtual void set_poses(SceneState& state, const Work& work) = 0;
    // Selects a cut. Waits. `last_bin` is that of SelectInput. Called without Python's
    // lock, by one thread at a time.
    virtual void select(const SceneState& state, const Eyes& eyes, const SelectRule& rule,
                        uint32_t* last_bin, const Work& work, SelectOutput& out) const = 0;
};

// The slots of a page pool on the device. It is made from a PagePool, which must
// outlive it.
class Pool {
  public:
    virtual ~Pool() = default;
    // Takes a step towards settling a view: brings in all pages that were read, selects
    // the cut without drawing it, and waits until the pool has decided about the pages
    // that the cut needs. `begins` says that it is the first step, which forgets
    // earlier frames (PagePool::begin_settling). Called without Python's lock.
    virtual SettlingStep settle_step(const Scene& scene, const SceneState& state, const Eyes& eyes,
                                     const SelectRule& rule, bool begins, const Work& work) = 0;
};

// The inputs of one picture; the bindings have checked that they are consistent with
// each other and with the frame.
struct FrameInput {
    const FrameRequest& request;
    const Scene& scene;
    std::shared_ptr<const SceneState> state;
    Pool* pool;                     // null: draw the frame's own models
    BudgetSteps* steps;             // pacing state of a sequence of pictures; null for a single one
    const std::atomic<bool>* stop;  // asks to end the picture early, if possible; may be null
};

// The inputs of a batch; checked as those of a picture.
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
    // Sets the model of each bundle and, unless empty, the palette of each; the frame
    // shares them.
    virtual void set_models(std::vector<std::shared_ptr<const Model>> models,
                            std::vector<std::shared_ptr<const Palette>> palettes,
                            const Work& work) = 0;
    // Draws the picture. A drawing that is unfinished on return keeps the frame, the
    // scene, the pool and the request alive (BoundDrawing::keep), and they do not
    // change until it is finished or destroyed. A backend whose frames share buffers
    // uses a Turn. A given cut has one eye.
    virtual std::unique_ptr<BoundDrawing> draw(const FrameInput& input) = 0;
    // Draws a batch of pictures with the frame's own models. As draw(), but the caller
    // owns the planes, which exist until the drawing is finished. A batch that does not
    // fit into the memory is drawn in parts.
    virtual std::unique_ptr<BoundBatch> draw_batch(const BatchInput& input) = 0;
    // Finds the gaussian with the largest weight in the first pixel of the window;
    // returns false if the pixel is empty. Waits. Called only if draws_only_plainly is
    // false.
    virtual bool pick(const FrameInput& input, ScenePick& picked) = 0;
    // Returns the bytes that the frame holds on the device by part, and the bytes of
    // the memory pool from which all parts are allocated.
    virtual std::vector<std::pair<const char*, size_t>> memory() const = 0;
};

// Draws all gaussians of one model of rows.
class AssetFrame {
  public:
    virtual ~AssetFrame() = default;
    // As Frame::draw(), for one camera.
    virtual std::unique_ptr<BoundDrawing> draw(const Camera& camera, const Shade& shade,
                                               const std::atomic<bool>* stop) = 0;
};

// The gaussians that groups or cuts are fitted to. The functions wait, and poll
// FitProgress::cancel. Called without Python's lock.
class Target {
  public:
    virtual ~Target() = default;
    // See fit_level() in levels/fit_level.h; `error` is on the host.
    virtual void fit_level(const FitConfig& config, Span<const FitGroup> groups,
                           const GaussianRows<float>& gaussians, float* error,
                           FitProgress& progress, const Work& work) const = 0;
    // As refine_cuts() (levels/refine_cuts.h) has it.
    virtual void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                             const CutRows& levels, const CutPictures& pictures,
                             FitProgress& progress, const Work& work) const = 0;
};

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
    // Returns the device of an array; nullopt if the array is not one of this
    // backend's.
    virtual std::optional<Device> device_of(const py::handle& array) const = 0;
    // Borrows an array after checks of its kind, dtype, shape, layout and device.
    virtual Borrowed borrow(Device device, const py::handle& array, const char* name,
                            const Element& element, Shape shape, bool is_written) const = 0;
    // Returns a new, uninitialised array.
    virtual MadeArray make_array(Device device, const Element& element,
                                 const std::vector<py::ssize_t>& shape) const = 0;
    // Returns the array as a NumPy array. Waits.
    virtual py::object to_host(const py::object& array) const = 0;
    // Returns a NumPy array as an array on the device.
    virtual py::object from_host(const py::object& array, Device device) const = 0;

    // ---- work

    // Makes a device the current one of this thread, and returns torch's current stream
    // on it.
    virtual Entered enter(Device device) const = 0;
    virtual void leave(Device device, int device_before) const noexcept = 0;

    // ---- operations; their headers have the contracts; without Python's lock

    // Waits, because `leaf_offset` is on the host.
    virtual void median_split(Span<const Point> points, Span<const int64_t> offset, int depth,
                              Span<int64_t> order, Span<int64_t> leaf_offset,
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
    // Called only if computes_doubles is true.
    virtual void ellipses(const EllipsesInput<double>& in, const Ellipses<double>& out,
                          const Work& work) const = 0;
    // Waits, because the sums are on the host.
    virtual void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& gaussians,
                            const CutPictures& pictures, const SeenOfGaussians& seen,
                            FitProgress& progress, const Work& work) const = 0;

    // ---- handles

    virtual std::shared_ptr<const backend::Tables> make_tables(const BoundTable& table,
                                                               const Work& work) const = 0;
    // Make a model of float32 rows or of codes (BoundCodes), which borrows them and
    // keeps them alive.
    virtual std::shared_ptr<const backend::Model> make_model(const Rows& rows,
                                                             const Work& work) const = 0;
    virtual std::shared_ptr<const backend::Model> make_model(const py::object& codes,
                                                             const Work& work) const = 0;
    // Makes a palette; `sh` is (C, 3), the SH coefficients of degree 0 of the clusters
    // of a ClusterTable.
    virtual std::shared_ptr<const backend::Palette> make_palette(const py::object& table,
                                                                 const py::array& sh,
                                                                 const Work& work) const = 0;
    virtual std::unique_ptr<backend::Scene> make_scene(const Work& work) const = 0;
    virtual PoolDemands pool_demands(int max_sh_degree) const = 0;
    // Makes a pool; `tables` are ClusterTables, in the order of the pool's bundles.
    virtual std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list& tables,
                                                     const Work& work) const = 0;
    virtual std::unique_ptr<backend::Frame> make_frame(const Work& work) const = 0;
    virtual std::unique_ptr<backend::AssetFrame> make_asset_frame(
        std::shared_ptr<const backend::Model> model, Appearance<float> appearance,
        const Work& work) const = 0;
    virtual std::unique_ptr<backend::Target> make_target(const Rows& rows, float filter_px2,
                                                         bool antialiased) const = 0;

    // ---- gradients

    // Draws gaussians without levels. If `keep_tape` is true, the result has a tape,
    // which keeps the gaussians alive.
    virtual Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera,
                                 const DrawLook& look, bool with_depth, bool keep_tape) const = 0;
};

// Returns the backend of a device; throws RuntimeError if it was not compiled.
const Backend& backend_of(Device device);

// Return the backend of the host, and the backend of devices, which is null if none was
// compiled.
const Backend& host_backend();
const Backend* device_backend();

// Returns the backend of CUDA devices (cuda_backend.cpp); defined only if CUDA was
// compiled.
const Backend& cuda_backend();

// Throws ValueError with the message "name: problem" unless the device is the host.
void check_is_on_host(Device device, const char* name, const char* problem);

}  // namespace v3dg

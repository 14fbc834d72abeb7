#pragma once

// The seam between the bindings and what computes: a Backend is the host, or one kind of device.
// The bindings check what Python gives them, and call the backend that backend_of() names; bound
// classes hold handles that it made (namespace backend). Nothing but the sources of a backend knows
// how a device works.
//
// Add a backend (WebGPU, HIP, Metal):
// 1. `<name>_backend.cpp` beside this header: a class derived from Backend, and one derived from
//    each handle of the namespace backend. host_backend.cpp and host_frame.cpp are the model, and
//    need no device; cuda_backend.cpp and cuda_frame.cpp show what changes on one.
// 2. A list of its sources in CMakeLists.txt, as V3DG_CUDA_BINDINGS is, which is compiled only
//    where the device's compiler is found.
// 3. device_backend() in backend.cpp returns it. That is the only `#if` of the bindings. A module
//    has the host and at most one kind of device; for two, `Device` (base/dispatch.h) gets a kind,
//    and backend_of() looks at that.
// 4. `v3dg/_device.py` finds its devices. The tests of an operation then run on it through their
//    fixture `device`; agreement is that of STYLE.md: decisions bit by bit, floats within bounds.
//
// What it must supply, in this order: arrays, work, operations, handles, drawing, fits. Each
// function below says more.
//
// Python's lock. A function is called with it, unless it is in the part "without Python's lock".
// Who is called with it and works or waits for long gives it up meanwhile (Unlocked).
// Streams. Work is queued on `Work::stream()`, which is the caller's, and on no other that the
// caller would have to wait for. Memory that Python gave may be reused on that stream on return.
// Waiting. A function returns when its work is queued. Where it says "waits", results are on the
// host on return.
// Ownership. Handles are owned by bound objects and destroyed with Python's lock. A handle that
// borrows from a Python object keeps a reference to it. Spans are good until the function returns,
// or, of arrays on the device, until what is queued is done, for torch keeps that memory in the
// stream's order.
// Errors. What the bindings have checked is not checked again. std::bad_alloc becomes a
// MemoryError, std::invalid_argument and py::value_error a ValueError, std::runtime_error a
// RuntimeError.

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

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

// What Backend::enter() changed and found.
struct Entered {
    int device_before;  // which leave() makes the current one again
    void* stream;
};

// What a backend's arrays can do.
struct BackendTraits {
    bool host_reads_arrays;   // so that their values can be checked
    bool computes_doubles;    // float64 gaussians are drawn and differentiated
    size_t row_alignment;     // bytes, of quaternions and coefficients
    bool draws_only_plainly;  // requests are plain (FrameRequest::is_plain), and nothing is picked
};

// What a pool takes of the memory of a device.
struct PoolDemands {
    size_t most_block_bytes;  // of pages on their way: what comes in while a few frames are drawn
    size_t row_bytes;         // of a gaussian whose pages are rows
    size_t most_coded_rows;   // that codes can have places for; 0: as many as PoolMemory says
    size_t most_frames;       // whose cuts may be under way at once
    std::shared_ptr<BlockMemory> blocks;
};

namespace backend {

// Tables of one bundle on a device: selection and drawing read them. All scenes of the device share
// them.
class Tables {
  public:
    virtual ~Tables() = default;
    virtual size_t bytes() const = 0;
};

// Gaussians of one bundle or asset, as frames read them.
class Model {
  public:
    virtual ~Model() = default;
    // Memory that it takes beside the arrays that it was made of.
    virtual size_t bytes() const = 0;
    // Writes the gaussians of clusters, of a model of codes; those of cluster k begin at offset[k].
    // Without Python's lock.
    virtual void decode(Span<const int32_t> clusters, Span<const int64_t> offset, const Work& work,
                        const GaussianRows<float>& out) const = 0;
};

// Colours of the clusters of one bundle.
class Palette {
  public:
    virtual ~Palette() = default;
};

// What selection reads of a scene. `state` is what the host knows of it.
class Scene {
  public:
    virtual ~Scene() = default;
    // Takes the place of all bundles; instances come next.
    virtual void set_bundles(const SceneState& state, const Work& work) = 0;
    // Instances and poses that `state.arrays` has. A backend whose arrays the host reads puts the
    // poses into `state.instances`. ValueError or TypeError where an array of poses is wrong, which
    // then changes nothing.
    virtual void set_instances(SceneState& state, const Work& work) = 0;
    // The same, of which only the poses are new.
    virtual void set_poses(SceneState& state, const Work& work) = 0;
    // Waits. `last_bin` as SelectInput has it. Without Python's lock, one thread at a time.
    virtual void select(const SceneState& state, const Eyes& eyes, const SelectRule& rule,
                        uint32_t* last_bin, const Work& work, SelectOutput& out) const = 0;
};

// The slots of a page pool on the device. Made of a PagePool, which outlives it.
class Pool {
  public:
    virtual ~Pool() = default;
    // Takes a step towards settling a view: brings all pages that were read, cuts the scene without
    // drawing it, and waits until the pool has decided about what the cut needs. `begins`: the
    // first step, which forgets earlier frames (PagePool::begin_settling). Without Python's lock.
    virtual SettlingStep settle_step(const Scene& scene, const SceneState& state, const Eyes& eyes,
                                     const SelectRule& rule, bool begins, const Work& work) = 0;
};

// What one picture is drawn from and with, checked to fit each other and the frame.
struct FrameInput {
    const FrameRequest& request;
    const Scene& scene;
    std::shared_ptr<const SceneState> state;
    Pool* pool;                     // null: the models that the frame has
    BudgetSteps* steps;             // of pictures that follow each other; null: of a single one
    const std::atomic<bool>* stop;  // where it can: ends the picture early; may be null
};

// Draws scenes of the same bundles.
class Frame {
  public:
    virtual ~Frame() = default;
    // Models of each bundle and, unless there are none, as many palettes, which it shares.
    virtual void set_models(std::vector<std::shared_ptr<const Model>> models,
                            std::vector<std::shared_ptr<const Palette>> palettes,
                            const Work& work) = 0;
    // Draws what is asked for. What it draws from stays as it is until the drawing is finished or
    // gone: a drawing that is not done on return keeps the frame, the scene, the pool and the
    // request (BoundDrawing::keep). A backend whose frames share buffers takes a Turn. A given cut
    // is for one eye.
    virtual std::unique_ptr<BoundDrawing> draw(const FrameInput& input) = 0;
    // Finds what the first pixel of a window shows most of; returns whether there is anything.
    // Waits. Only where draws_only_plainly is false.
    virtual bool pick(const FrameInput& input, ScenePick& picked) = 0;
    // Bytes of what it keeps on the device, by part, and of the memory that all parts are from.
    virtual std::vector<std::pair<const char*, size_t>> memory() const = 0;
};

// Draws all gaussians of one model, which has rows.
class AssetFrame {
  public:
    virtual ~AssetFrame() = default;
    // As Frame::draw(), of one camera.
    virtual std::unique_ptr<BoundDrawing> draw(const Camera& camera, const Shade& shade,
                                               const std::atomic<bool>* stop) = 0;
};

// What groups or cuts are fitted to. The calls wait, and look at FitProgress::cancel now and then.
// Without Python's lock.
class Target {
  public:
    virtual ~Target() = default;
    // See fit_level() in levels/fit_level.h; `error` is on the host.
    virtual void fit_level(const FitConfig& config, Span<const FitGroup> groups,
                           const GaussianRows<float>& gaussians, float* error,
                           FitProgress& progress, const Work& work) const = 0;
    // As refine_cuts() (levels/refine_cuts.h) has it.
    virtual void refine_cuts(const FitConfig& config, const CutRows& levels,
                             const CutPictures& pictures, FitProgress& progress,
                             const Work& work) const = 0;
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

    // How many devices there are.
    virtual int num_devices() const = 0;
    // Where an array is; nothing where it is none of this backend's.
    virtual std::optional<Device> device_of(const py::handle& array) const = 0;
    // Borrows an array after checks of its kind, dtype, shape, layout and device.
    virtual Borrowed borrow(Device device, const py::handle& array, const char* name,
                            const Element& element, Shape shape, bool is_written) const = 0;
    // A new array, not initialised.
    virtual MadeArray make_array(Device device, const Element& element,
                                 const std::vector<py::ssize_t>& shape) const = 0;
    // The same array as one of NumPy's. Waits.
    virtual py::object to_host(const py::object& array) const = 0;
    // An array of NumPy's on the device.
    virtual py::object from_host(const py::object& array, Device device) const = 0;

    // ---- work

    // Makes a device the current one of this thread, and finds the stream that torch has there.
    virtual Entered enter(Device device) const = 0;
    virtual void leave(Device device, int device_before) const noexcept = 0;

    // ---- operations, as their headers have them; without Python's lock

    // Waits, for `leaf_offset` is on the host.
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
    // Only where computes_doubles is true.
    virtual void ellipses(const EllipsesInput<double>& in, const Ellipses<double>& out,
                          const Work& work) const = 0;
    // Waits, for the sums are on the host.
    virtual void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& gaussians,
                            const CutPictures& pictures, const SeenOfGaussians& seen,
                            FitProgress& progress, const Work& work) const = 0;

    // ---- handles

    virtual std::shared_ptr<const backend::Tables> make_tables(const BoundTable& table,
                                                               const Work& work) const = 0;
    // Of rows, which are float32, or of codes (BoundCodes). It keeps what it borrows.
    virtual std::shared_ptr<const backend::Model> make_model(const Rows& rows,
                                                             const Work& work) const = 0;
    virtual std::shared_ptr<const backend::Model> make_model(const py::object& codes,
                                                             const Work& work) const = 0;
    // `sh` is (C, 3), coefficients of the constant basis of the clusters of a ClusterTable.
    virtual std::shared_ptr<const backend::Palette> make_palette(const py::object& table,
                                                                 const py::array& sh,
                                                                 const Work& work) const = 0;
    virtual std::unique_ptr<backend::Scene> make_scene(const Work& work) const = 0;
    virtual PoolDemands pool_demands(int max_sh_degree) const = 0;
    // `tables` are ClusterTables, in the order of the pool's bundles.
    virtual std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list& tables,
                                                     const Work& work) const = 0;
    virtual std::unique_ptr<backend::Frame> make_frame(const Work& work) const = 0;
    virtual std::unique_ptr<backend::AssetFrame> make_asset_frame(
        std::shared_ptr<const backend::Model> model, Appearance<float> appearance,
        const Work& work) const = 0;
    virtual std::unique_ptr<backend::Target> make_target(const Rows& rows, float filter_px2,
                                                         bool antialiased) const = 0;

    // ---- gradients

    // Draws gaussians without levels. The tape keeps them, and is there if it is asked for.
    virtual Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera,
                                 const DrawLook& look, bool with_depth, bool keep_tape) const = 0;
};

// The backend of a device; RuntimeError where it is not compiled in.
const Backend& backend_of(Device device);

// The backend of the host, and the backend of devices, which is null if none is compiled in.
const Backend& host_backend();
const Backend* device_backend();

// Of the CUDA half (cuda_backend.cpp), which is there only where it is compiled.
const Backend& cuda_backend();

// ValueError, name: problem, unless this is the host.
void check_is_on_host(Device device, const char* name, const char* problem);

}  // namespace v3dg

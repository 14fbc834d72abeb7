#pragma once

// Selection on CUDA. It computes the cut of a scene that is on the device, as items of
// a frame or as pairs.

#include "frame/draw_list.h"
#include "frame/image.h"
#include "residency/scene_tables.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

struct CutPart;
struct BudgetState;

// The head of a cut's report to the host about the pages that it needs.
struct NeedsReport {
    // Number of needed pages, including those that do not fit in the list.
    unsigned count;
    float tolerance_px2;
};

// The memory in which a cut collects the pages that it needs. `report` and `reported`
// are in host memory, and the rest on the device.
struct NeedList {
    // The number of needed pages, followed by one element per page of all bundles. The
    // cut clears this memory first.
    uint32_t* words = nullptr;
    size_t num_words = 0;
    uint32_t* const* need = nullptr;  // for each bundle, its elements in `words`
    PageRequest* list = nullptr;
    unsigned capacity = 0;  // largest length of `list` and of `reported`
    NeedsReport* report = nullptr;
    PageRequest* reported = nullptr;
};

// What a cut reads from a pool, in which only some pages are resident, and what it
// reports to the pool.
struct PartlyResident {
    const BundleOnDevice* bundles;
    NeedList needs;  // `report` is null if no report is wanted
};

// A camera of a batch on the device. A camera that is not drawn sees nothing.
struct BatchCamera {
    Camera camera;
    int32_t environment;  // as described at EnvironmentTable
    uint32_t is_drawn;
};

// The arrays of a batch's cameras on the device.
struct CameraArrays {
    // (B, 4, 4); (B, 3, 3), or (3, 3) for all cameras
    const void *viewmats, *intrinsics;
    const void* environments;  // (B,); null if each camera sees all instances
    // Whether an array has doubles, not floats; whether all cameras share the
    // intrinsics.
    bool are_viewmats_double, are_intrinsics_double, shares_intrinsics;
    bool are_environments_long;  // whether they are int64 instead of int32
    int width, height;
    double near_depth;
};

// The source from which the cameras of a batch are read.
enum class CameraSource {
    arrays,
    // Copies. A frame that is drawn again uses these, because the arrays may have
    // changed.
    copies,
};

// The viewpoints of a batch, and the places of their instances. The instance in slot s
// of camera b has place b * num_slots + s. A camera is not drawn if its numbers are
// invalid, or if the scene does not have its environment.
struct BatchViews {
    CameraArrays arrays;    // arrays of all cameras of the batch
    uint32_t first_camera;  // first camera of these views
    uint32_t num_cameras;
    CameraSource source;
    // Copies of the cameras of these views, which are written or read.
    BatchCamera* cameras;
    uint32_t num_slots;  // returned by batch_slots()
    size_t most_parts;   // largest number of parts of the tables that one camera sees
    // Image of the first camera. The images of the other cameras follow it.
    FrameImage first;
    BatchPlanes planes;   // planes of all images
    ImageCounts* counts;  // counts of all images, which the cut clears

    size_t num_places() const { return size_t(num_cameras) * num_slots; }
};

// Returns the number of slots per camera in a batch. A camera sees at most
// `most_instances` instances.
size_t batch_slots(size_t most_instances);

// Memory for the placements of a batch, with one element per place.
struct BatchPlacements {
    FrameImage* images;  // one per camera
    Placement* placements;
    InstanceFactors* factors;  // null if the scene has no factors
};

// Computes cuts of scenes on the device that is current at construction. It owns the
// scratch memory of a cut, so only one cut can run at a time. Cuts of one scene are
// ordered by the lock of that scene, whatever their threads and streams. The caller
// must order cuts of different scenes. Scenes and streams must belong to the same
// device.
//
// Only select() waits. Memory is only allocated for a scene that is larger than all
// earlier ones. A graph that captured a cut is valid until a larger scene is cut.
class Cut {
  public:
    // Writes the selected clusters as items of a frame, once per eye. Also writes the
    // `pictures` to `images`. With n instances, instance i becomes placement i of model
    // bundle[i] in the first image, and placement n + i in the image of a second eye.
    // The counters and zeros of `items` must be zero.
    void cut_items(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                   const EyeImages& pictures, FrameImage* images, Placement* placements,
                   const ItemList& items, cudaStream_t stream,
                   const PartlyResident* resident = nullptr);

    // Returns the number of elements that cut_items() needs in items.zeros.
    static size_t num_zeros(const SceneTables& scene, const SelectRule& rule);

    // Writes the clusters that each camera of a batch draws, as items of a frame. The
    // decisions equal those of cut_items(). The rule must not have a budget.
    void cut_batch(const SceneTables& scene, const BatchViews& views, const SelectRule& rule,
                   const BatchPlacements& out, const ItemList& items, cudaStream_t stream);

    // Returns the number of elements that cut_batch() needs in items.zeros.
    static size_t num_batch_zeros(size_t num_places);

    // Writes a cut that was selected earlier as items for one camera. The cut must be
    // in device memory.
    void given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                     const FrameImage& image, FrameImage* images, Placement* placements,
                     const ItemList& items, cudaStream_t stream);

    // Selects clusters, waits, and returns them as pairs in host memory. `last_bin` is
    // as in SelectInput. If it is null, the state is kept on the device.
    void select(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                SelectOutput& out, cudaStream_t stream, const PartlyResident* resident = nullptr,
                uint32_t* last_bin = nullptr);

    size_t bytes() const;

  private:
    struct Pairs {
        unsigned long long pairs, gaussians;
        CutChoice choice;
    };
    struct Target;
    template <class Output>
    void cut(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
             const Target& target, const Output& output, unsigned long long* zeros,
             cudaStream_t stream, const PartlyResident* resident);
    template <bool kFades>
    void select_pairs(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                      SelectOutput& out, cudaStream_t stream, const PartlyResident* resident,
                      uint32_t* last_bin);
    BudgetState* budget_state(cudaStream_t stream);

    const int device_ = current_device();
    DeviceBuffer<CameraSides> sides_;
    DeviceBuffer<InstanceView> views_;
    DeviceBuffer<uint8_t> tops_;
    DeviceBuffer<int32_t> bundle_of_place_;
    DeviceBuffer<CutPart> parts_;
    DeviceBuffer<unsigned long long> states_, zeros_;
    DeviceBuffer<BudgetState> budget_;
    DeviceBuffer<int32_t> pair_instance_, pair_cluster_;
    DeviceBuffer<float> pair_weight_;
    DeviceBuffer<Pairs> pairs_;
};

}  // namespace cuda
}  // namespace v3dg

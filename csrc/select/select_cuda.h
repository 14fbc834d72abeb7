#pragma once

// Selection on CUDA: the interface. It computes the cut of a scene that is on the
// device, as the items of a frame or as pairs.

#include "frame/draw_list.h"
#include "frame/image.h"
#include "residency/scene_tables.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

struct CutPart;
struct BudgetState;

// The head of a cut's report to the host about needed pages.
struct NeedsReport {
    // Number of needed pages, including those for which the list has no room.
    unsigned count;
    float tolerance_px2;
};

// The memory in which a cut collects the pages that it needs. It is on the device,
// except for `report` and `reported`, which are in host memory.
struct NeedList {
    // The number of needed pages, then one element per page of all bundles. The cut
    // clears this memory first.
    uint32_t* words = nullptr;
    size_t num_words = 0;
    uint32_t* const* need = nullptr;  // per bundle: its elements in `words`
    PageRequest* list = nullptr;
    unsigned capacity = 0;  // largest length of `list` and of `reported`
    NeedsReport* report = nullptr;
    PageRequest* reported = nullptr;
};

// What a cut reads and requests in a pool, where only some pages are resident.
struct PartlyResident {
    const BundleOnDevice* bundles;
    NeedList needs;  // `report` is null if no report is requested
};

// A camera of a batch on the device. A camera that is not drawn sees nothing.
struct BatchCamera {
    Camera camera;
    int32_t environment;  // as in EnvironmentTable
    uint32_t is_drawn;
};

// The arrays of a batch's cameras on the device.
struct CameraArrays {
    // (B, 4, 4); (B, 3, 3), or (3, 3) for all cameras
    const void *viewmats, *intrinsics;
    const void* environments;  // (B,); null if the cameras see all instances
    // Whether an array has doubles, not floats; whether all cameras share the
    // intrinsics.
    bool are_viewmats_double, are_intrinsics_double, shares_intrinsics;
    bool are_environments_long;  // int64, not int32
    int width, height;
    double near_depth;
};

// The source from which the cameras of a batch are read.
enum class CameraSource {
    arrays,
    // Copies; for a frame that is drawn again, because the arrays may have changed.
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
    // Copies of the cameras of these views, to be written or read.
    BatchCamera* cameras;
    uint32_t num_slots;  // result of batch_slots()
    size_t most_parts;   // largest number of parts of the tables that one camera sees
    // Image of the first camera; the images of the other cameras follow.
    FrameImage first;
    BatchPlanes planes;   // planes of all images
    ImageCounts* counts;  // counts of all images; the cut clears them

    size_t num_places() const { return size_t(num_cameras) * num_slots; }
};

// Returns the number of slots of each camera of a batch, if a camera sees at most
// `most_instances` instances.
size_t batch_slots(size_t most_instances);

// Memory for the placements of a batch, one element per place.
struct BatchPlacements {
    FrameImage* images;  // one per camera
    Placement* placements;
    InstanceFactors* factors;  // null if the scene has no factors
};

// Computes cuts of scenes on the device that is current at construction. It owns the
// scratch memory of a cut, so only one cut can run at a time. Cuts of one scene are
// ordered by the lock of that scene, on any threads and streams; the caller must order
// cuts of different scenes. Scenes and streams must belong to the same device.
//
// Only select() waits. Memory is allocated only for a scene that is larger than all
// earlier ones. A graph that captured a cut is valid until a larger scene is cut.
class Cut {
  public:
    // Writes the selected clusters as items of a frame, once per eye, and the
    // `pictures` to `images`. With n instances, instance i becomes placement i of model
    // bundle[i] in the first image, and placement n + i in the image of a second eye.
    // The counters and zeros of `items` must be zero.
    void cut_items(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                   const EyeImages& pictures, FrameImage* images, Placement* placements,
                   const ItemList& items, cudaStream_t stream,
                   const PartlyResident* resident = nullptr);

    // Returns the number of elements that cut_items() needs in items.zeros.
    static size_t num_zeros(const SceneTables& scene, const SelectRule& rule);

    // Writes the clusters that each camera of a batch draws as items of a frame.
    // Decisions are equal to the decisions of cut_items(). The rule has no budget.
    void cut_batch(const SceneTables& scene, const BatchViews& views, const SelectRule& rule,
                   const BatchPlacements& out, const ItemList& items, cudaStream_t stream);

    // Returns the number of elements that cut_batch() needs in items.zeros.
    static size_t num_batch_zeros(size_t num_places);

    // Writes a cut that was selected earlier, and is in device memory, as items for one
    // camera.
    void given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                     const FrameImage& image, FrameImage* images, Placement* placements,
                     const ItemList& items, cudaStream_t stream);

    // Selects clusters, waits, and returns them as pairs in host memory. `last_bin` is
    // as in SelectInput; if it is null, the state is kept on the device.
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

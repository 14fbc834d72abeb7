#pragma once

// The contract of selection on CUDA: it computes cuts of a scene on the device, as the
// items of a frame or as pairs.

#include "frame/draw_list.h"
#include "frame/image.h"
#include "residency/scene_tables.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

struct CutPart;
struct BudgetState;

// The report of a cut to the host about the pages that it needs.
struct NeedsReport {
    unsigned count;  // number of needed pages, including those that do not fit into the list
    float tolerance_px2;
};

// Memory for the pages that a cut needs. It is on the device, except for the report,
// which the device writes to host memory.
struct NeedList {
    // The number of pages, then one element per page of all bundles; the cut clears
    // them.
    uint32_t* words = nullptr;
    size_t num_words = 0;
    uint32_t* const* need = nullptr;  // where the elements of each bundle begin
    PageRequest* list = nullptr;
    unsigned capacity = 0;  // of the list, and of the report
    NeedsReport* report = nullptr;
    PageRequest* reported = nullptr;
};

// The bundles of a scene that are only partly resident.
struct PartlyResident {
    const BundleOnDevice* bundles;
    NeedList needs;  // without a report if none is requested
};

// A camera of a batch on the device. One that is not drawn sees nothing.
struct BatchCamera {
    Camera camera;
    int32_t environment;  // as in EnvironmentTable
    uint32_t is_drawn;
};

// The arrays of a batch's cameras on the device.
struct CameraArrays {
    const void *viewmats, *intrinsics;  // (B, 4, 4); (B, 3, 3), or (3, 3) for all
    const void* environments;           // (B,), null if the cameras see all instances
    bool are_viewmats_double, are_intrinsics_double, shares_intrinsics;  // else float
    bool are_environments_long;                                          // else 32 bits
    int width, height;
    double near_depth;
};

// Reads the cameras of a batch. A camera whose numbers are wrong, or whose environment
// the scene does not have, is not drawn.
void read_cameras(const CameraArrays& arrays, const SceneTables& scene, uint32_t count,
                  BatchCamera* cameras, cudaStream_t stream);

// The viewpoints of a batch, and where their instances are placed. The instance in slot
// s of camera b has place b * num_slots + s.
struct BatchViews {
    const BatchCamera* cameras;
    uint32_t num_cameras;
    uint32_t num_slots;  // of each camera: batch_slots()
    size_t most_parts;   // of the tables that one camera sees
    FrameImage first;    // the image of the first camera; the others follow it
    BatchPlanes planes;  // of all images

    size_t num_places() const { return size_t(num_cameras) * num_slots; }
};

// Returns the number of slots of each camera of a batch, if a camera sees at most this
// many instances.
size_t batch_slots(size_t most_instances);

// Memory for the placements of a batch, one element per place.
struct BatchPlacements {
    FrameImage* images;  // per camera
    Placement* placements;
    InstanceFactors* factors;  // null if the scene has none
};

// Cuts scenes on the device that is current when it is constructed, and owns the
// scratch memory of a cut, which one cut uses at a time. The lock of a scene orders
// cuts of that scene on any threads and streams; the caller orders cuts of different
// scenes. Scenes and streams belong to the same device.
//
// No function but select() waits. Memory is allocated only for a scene that is larger
// than all earlier ones. A graph that captured a cut uses that memory, so the graph is
// valid until a larger scene is cut.
class Cut {
  public:
    // Writes the selected clusters as the items of a frame, once for each eye. Instance
    // i of n becomes placement i of model bundle[i] in image 0, and placement n + i in
    // the image of a second eye. Writes `pictures` to `images`. The caller clears what
    // needs to be cleared.
    void cut_items(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                   const EyeImages& pictures, FrameImage* images, Placement* placements,
                   const ItemList& items, cudaStream_t stream,
                   const PartlyResident* resident = nullptr);

    // Returns how many zeros cut_items() needs in items.zeros.
    static size_t num_zeros(const SceneTables& scene, const SelectRule& rule);

    // Writes the clusters that each camera of a batch draws as the items of a frame, with
    // the decisions of cut_items(). The rule has no budget.
    void cut_batch(const SceneTables& scene, const BatchViews& views, const SelectRule& rule,
                   const BatchPlacements& out, const ItemList& items, cudaStream_t stream);

    // Returns how many zeros cut_batch() needs in items.zeros.
    static size_t num_batch_zeros(size_t num_places);

    // Writes pairs that were selected earlier, and lie on the device, as items for one
    // camera.
    void given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                     const FrameImage& image, FrameImage* images, Placement* placements,
                     const ItemList& items, cudaStream_t stream);

    // Selects clusters as pairs on the host, and waits for them. `last_bin` is as in
    // SelectInput; if it is null, that state stays on the device.
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

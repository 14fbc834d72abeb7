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
    DeviceBuffer<CutPart> parts_;
    DeviceBuffer<unsigned long long> states_, zeros_;
    DeviceBuffer<BudgetState> budget_;
    DeviceBuffer<int32_t> pair_instance_, pair_cluster_;
    DeviceBuffer<float> pair_weight_;
    DeviceBuffer<Pairs> pairs_;
};

}  // namespace cuda
}  // namespace v3dg

#pragma once

// Contract of selection on CUDA: cuts of a scene on the device, as the items of a frame
// or as pairs.

#include "frame/draw_list.h"
#include "frame/image.h"
#include "residency/scene_tables.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

struct CutPart;
struct BudgetState;

// What a cut reports to the host about the pages that it needs.
struct NeedsReport {
    unsigned count;  // of all pages, including those that there is no room for
    float tolerance_px2;
};

// Memory for the pages that a cut needs. It is on the device, except for the report,
// which is memory of the host that the device writes to.
struct NeedList {
    // The number of pages, then one word for each page of all bundles; the cut clears
    // them.
    uint32_t* words = nullptr;
    size_t num_words = 0;
    uint32_t* const* need = nullptr;  // where the words of each bundle begin
    PageRequest* list = nullptr;
    unsigned capacity = 0;  // of the list, and of the report
    NeedsReport* report = nullptr;
    PageRequest* reported = nullptr;
};

// The bundles of a scene of which only some pages are resident.
struct PartlyResident {
    const BundleOnDevice* bundles;
    NeedList needs;  // without a report where they are not wanted
};

// Cuts scenes on the device that is current when it is constructed, and owns the
// scratch memory of a cut, which one cut uses at a time. Cuts of one scene are ordered
// by the scene's lock, on any threads and streams; the caller orders cuts of several
// scenes. Scenes and streams belong to the same device.
//
// No function but select() waits. Memory is allocated only for a scene that is larger
// than all before. A graph that captured a cut uses that memory, so it is valid until a
// larger scene is cut.
class Cut {
  public:
    // Writes the selected clusters as the items of a frame, once for each eye. Instance
    // i of n becomes placement i of model bundle[i] in image 0, and placement n + i in
    // the image of a second eye. Writes `pictures` to `images`. Clears nothing.
    void cut_items(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                   const EyeImages& pictures, FrameImage* images, Placement* placements,
                   const ItemList& items, cudaStream_t stream,
                   const PartlyResident* resident = nullptr);

    // How many zeros cut_items() needs in items.zeros.
    static size_t num_zeros(const SceneTables& scene, const SelectRule& rule);

    // Writes pairs that were selected before, and lie on the device, as items, for one
    // camera.
    void given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                     const FrameImage& image, FrameImage* images, Placement* placements,
                     const ItemList& items, cudaStream_t stream);

    // Selects clusters as pairs on the host, and waits for them. `last_bin` is as in
    // SelectInput; where it is null, that state stays on the device.
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

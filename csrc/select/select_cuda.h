#pragma once

#include "frame/draw_list.h"
#include "frame/image.h"
#include "residency/scene_tables.h"
#include "select/select.h"

namespace v3dg {
namespace cuda {

struct CutPart;
struct BudgetState;

// What the host reads of the pages that a cut needs, once it is over.
struct NeedsReport {
    unsigned count;  // of the pages; of those that there is no room for, nothing else is told
    float tolerance_px2;
};

// Where a cut tells which pages it needs. Everything is on the device but the report, which is
// memory of the host that the device writes to.
struct NeedList {
    uint32_t* words =
        nullptr;  // the number of pages, then a word a page of all bundles; cleared by the cut
    size_t num_words = 0;
    uint32_t* const* need = nullptr;  // the words of each bundle
    PageRequest* list = nullptr;
    unsigned capacity = 0;  // of the list, and of the report
    NeedsReport* report = nullptr;
    PageRequest* reported = nullptr;
};

// The bundles of a scene of which only some pages are resident.
struct PartlyResident {
    const BundleOnDevice* bundles;
    NeedList needs;  // without a report: nobody asks
};

// Cuts of scenes on the device that is current when it is made: the memory that a cut needs in
// between. One cut uses it at a time. The cuts of one scene take turns by themselves, on any
// threads and streams; whoever cuts several scenes orders those. Scenes and streams are of the same
// device.
//
// Nothing waits, and nothing is allocated for a scene that is not larger than the largest before. A
// graph that captured a cut goes on using the memory, and so holds until a larger scene is cut.
class Cut {
  public:
    // Selected clusters as the items of a frame, once for each eye. Instance i of n becomes
    // placement i of model bundle[i] in image 0, and n + i in that of a second eye; `pictures` are
    // written to `images`. Clears nothing.
    void cut_items(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                   const EyeImages& pictures, FrameImage* images, Placement* placements,
                   const ItemList& items, cudaStream_t stream,
                   const PartlyResident* resident = nullptr);

    // How many zeros items.zeros has to have for that.
    static size_t num_zeros(const SceneTables& scene, const SelectRule& rule);

    // The same for pairs that were selected before, on the device, and one camera.
    void given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                     const FrameImage& image, FrameImage* images, Placement* placements,
                     const ItemList& items, cudaStream_t stream);

    // Selected clusters as pairs on the host, for which it waits. `last_bin` as SelectInput has it;
    // null: it stays on the device.
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
    DeviceBuffer<FrustumSides> sides_;
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

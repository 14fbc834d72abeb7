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

// The bundles of a scene of which only some pages are resident.
struct PartlyResident {
    const BundleOnDevice* bundles;
    NeedList needs;  // `report` is null if no report is requested
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
    DeviceBuffer<CutPart> parts_;
    DeviceBuffer<unsigned long long> states_, zeros_;
    DeviceBuffer<BudgetState> budget_;
    DeviceBuffer<int32_t> pair_instance_, pair_cluster_;
    DeviceBuffer<float> pair_weight_;
    DeviceBuffer<Pairs> pairs_;
};

}  // namespace cuda
}  // namespace v3dg

#pragma once

// Transforms the cameras into the coordinates of each instance, chooses the source of
// the instance's cut, and divides the work into parts. There is one thread per
// instance.

#include "base/scan.cuh"
#include "select/cut_scratch.cuh"

namespace v3dg {
namespace cuda {

constexpr unsigned kFewBundles = 8;
// With at most kFewInstances instances, a part has at most kFewLanes lanes, so that the
// parts occupy the whole device.
constexpr unsigned kFewInstances = 8192, kFewLanes = 8;

// The frustum sides for each bundle. Computing them for each instance would cost eight
// divisions of doubles. If there are only a few bundles, their sides are passed as a
// kernel argument, and otherwise in memory.
struct BundleSides {
    CameraSides few[kFewBundles];
    const CameraSides* many;  // null if `few` is used

    __device__ CameraSides operator()(size_t bundle) const {
        if (many != nullptr) return many[bundle];
        return few[bundle];
    }
};

// Returns the placement of an instance in front of the camera of an image.
__device__ inline Placement placement_of(const InstanceAxes& axes, const Pose& pose, int32_t bundle,
                                         unsigned image) {
    return {.view = model_view_from_instance(axes, pose),
            .model = static_cast<uint32_t>(bundle),
            .image = image};
}

// Records in shared memory, one per lane of a warp. They let the warp write to global
// memory with coalesced stores.
template <class Record>
struct RecordRow {
    Record* records;

    __device__ void set(const Record& mine) const { records[threadIdx.x % 32] = mine; }
    // Writes the records of the lanes with `has_one` to consecutive positions,
    // beginning at `first`. All lanes of the warp must call it.
    __device__ void write(bool has_one, Record* first) const {
        constexpr unsigned kVectors = sizeof(Record) / sizeof(uint4);
        static_assert(sizeof(Record) % sizeof(uint4) == 0 && alignof(Record) % sizeof(uint4) == 0,
                      "records are copied as vectors of 16 bytes");
        const unsigned writers = __ballot_sync(kAllLanes, has_one);
        __syncwarp();
        if (writers == 0) return;
        const auto* from = reinterpret_cast<const uint4*>(records);
        auto* to = reinterpret_cast<uint4*>(first);
#pragma unroll
        for (unsigned k = 0; k < kVectors; ++k) {
            const unsigned v = 32 * k + threadIdx.x % 32;
            if (writers >> v / kVectors & 1) to[v] = from[v];
        }
        __syncwarp();  // set() overwrites the records
    }
};

// The result of place_instance(): the source of an instance's cut.
struct Placed {
    CutSource source;
    ClusterRange asked;  // the clusters to test, if the source is the table
    bool is_alone;       // whether a single lane tests these clusters
};

// The instance that a thread processes.
struct InstanceSlot {
    bool is_taken;    // whether the thread has an instance
    size_t instance;  // index of the instance in the scene
    size_t place;     // index at which results are written; consecutive in a warp
    unsigned image;   // image of the first eye
};

// Places an instance: writes its view, its placements and its top clusters. All lanes
// of the warp must call it. `sides_of` returns the frustum sides of a bundle. With n
// instances, instance i has placement n + i in front of a second eye.
template <class SidesOf>
__device__ inline Placed place_instance(const PlacedScene& scene, const InstanceSlot& slot,
                                        const Eyes& eyes, const SidesOf& sides_of,
                                        const SelectRule& rule, Placement* placements) {
    __shared__ InstanceView space[kPlaceThreads];
    static_assert(sizeof(Placement) <= sizeof(InstanceView),
                  "placements are stored in the memory of views");
    InstanceView* of_warp = space + threadIdx.x / 32 * 32;
    const RecordRow<Placement> placement_row{reinterpret_cast<Placement*>(of_warp)};
    const RecordRow<InstanceView> view_row{of_warp};
    const size_t i = slot.instance, first = slot.place - threadIdx.x % 32;
    const Pose pose = slot.is_taken
                          ? scene.instances.pose(i)
                          : Pose{.position = nullptr, .quaternion = nullptr, .scale = 0.0};
    CutSource source = CutSource::nowhere;
    ClusterRange asked{0, 0};
    bool is_alone = false;
    int32_t bundle = 0;
    InstanceView view;
    if (slot.is_taken && scene.instances.is_drawn(i)) {
        bundle = scene.instances.bundle[i];
        const ClusterTable& table = scene.bundles[bundle].table;
        {
            const InstanceAxes axes = axes_of_instance(eyes.camera[0], pose);
            view = view_from_instance(eyes, sides_of(bundle), axes, pose,
                                      scene.instances.importance[i]);
            // Store the placement before the instance is known to be visible. This
            // frees the registers of its axes.
            if (placements != nullptr)
                placement_row.set(placement_of(axes, pose, bundle, slot.image));
        }
        source = source_of_cut(table, view, rule, kLaneClusters);
        if (source == CutSource::tops) {
            const InstanceCut<AskedGroups> cut = cut_by_asking(table, view, rule);
            unsigned drawn = 0;
            for (unsigned k = 0; k < table.top_cluster.size; ++k)
                if (!cut.is_culled(table.top_cluster[k])) drawn |= 1u << k;
            scene.tops[slot.place] = static_cast<uint8_t>(drawn);
            if (drawn == 0) source = CutSource::nowhere;
        }
        // With a budget, the tolerance is not known yet, so the bounds must also hold
        // for all larger tolerances.
        if (source == CutSource::table) {
            asked = clusters_to_ask(
                table, scene.bundles[bundle].runs, view, rule,
                rule.budget == kNoBudget ? Tolerances::this_one : Tolerances::from_this_on);
            is_alone = asked.first < asked.end && asked.first >= last_of_table(table);
            if (is_alone) scene.tops[slot.place] = 0;
        }
        is_alone |= source == CutSource::tops;
    }
    const bool is_seen = source != CutSource::nowhere;
    if (placements != nullptr) {
        placement_row.write(is_seen, placements + first);
        if (eyes.are_two) {
            if (is_seen)
                placement_row.set(
                    placement_of(axes_of_instance(eyes.camera[1], pose), pose, bundle, 1));
            placement_row.write(is_seen, placements + scene.instances.scale.size + first);
        }
    }
    if (source == CutSource::table) view_row.set(view);
    view_row.write(source == CutSource::table, scene.views + first);
    return {.source = source, .asked = asked, .is_alone = is_alone};
}

// Writes the parts of a block's instances after those of earlier blocks, and clears the
// states of cut_kernel. All threads of the block must call it. Returns the number of
// parts up to and including this block.
//
// Consecutive instances form one part if a single lane can process each of them, and no
// instance with a full table is between them. The thread of the first instance writes
// the part. `place` is the place of the thread's instance. `num_instances` is the
// number of instances of its viewpoint.
__device__ inline unsigned write_parts(const PlacedScene& scene, const Placed& placed, size_t block,
                                       size_t place, size_t num_instances,
                                       const CutScratch& scratch) {
    const unsigned lane = threadIdx.x % 32, below = (1u << lane) - 1;
    const unsigned lanes = __ballot_sync(kAllLanes, placed.is_alone);
    const unsigned tables =
        __ballot_sync(kAllLanes, placed.source == CutSource::table && !placed.is_alone);
    const unsigned table_below = tables & below, table_above = tables & ~below;
    const unsigned width = num_instances <= kFewInstances ? kFewLanes : 32;
    const unsigned first = lane / width * width;
    const unsigned from =
        max(first, table_below != 0 ? 32 - __clz(static_cast<int>(table_below)) : 0);
    const unsigned to = min(first + width, table_above != 0 ? __ffs(table_above) - 1 : 32);
    const bool begins = placed.is_alone && (lanes & below) >> from == 0;
    const unsigned parts =
        placed.is_alone ? begins : blocks_for(placed.asked.end - placed.asked.first, kPartSize);

    unsigned total;
    const unsigned before_in_block = block_prefix(parts, total);
    __shared__ unsigned before_block;
    if (threadIdx.x < 32) {
        const unsigned before =
            static_cast<unsigned>(prefix_of_part(scratch.place_state, block, total));
        if (threadIdx.x == 0) before_block = before;
    }
    __syncthreads();
    const unsigned before = before_block;
    CutPart* part = scene.parts + before + before_in_block;
    if (begins) {
        const unsigned until = to < 32 ? (1u << to) - 1 : kAllLanes;
        *part = {
            .place = static_cast<uint32_t>(place), .first = 0, .lanes = (lanes & until) >> lane};
    } else if (!placed.is_alone) {
        for (unsigned p = 0; p < parts; ++p)
            part[p] = {.place = static_cast<uint32_t>(place),
                       .first = placed.asked.first + p * kPartSize,
                       .lanes = 0};
    }
    // Clear the states of all tickets that cut_kernel may use. If a ticket has
    // kCutWarps parts, each block clears the tickets whose first part belongs to the
    // block. If a ticket has fewer parts, there are at most num_places tickets, and all
    // blocks clear them together.
    const auto clear = [&](unsigned first, unsigned end, unsigned step) {
        for (unsigned t = first; t < end; t += step)
            scratch.unit_state[t] = scratch.count_state[t] = 0;
    };
    clear(static_cast<unsigned>(place), scratch.num_places, gridDim.x * kPlaceThreads);
    clear(blocks_for(before, kCutWarps) + threadIdx.x, blocks_for(before + total, kCutWarps),
          kPlaceThreads);
    return before + total;
}

}  // namespace cuda
}  // namespace v3dg

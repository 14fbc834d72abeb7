#pragma once

// The blocks that fit a group together, and their memory.
//
// Small groups keep frequently read arrays in shared memory. One block fits a group or,
// if there are few groups, a pair of blocks, each of which processes every other view.
// Large groups are in global memory; if there are fewer of them than multiprocessors,
// teams of blocks fit them.

#include "base/launch.cuh"
#include "fit_group/fit_group_math.h"
#include "fit_group/fit_memory.h"

namespace v3dg {
namespace cuda {

constexpr unsigned kLargestTeam = 16;

// The views that a block processes together.
struct FitCameras {
    FitStep step;  // the step of these views
    ModelView<float> view[kViewsAtOnce];
    Pinhole<float> camera[kViewsAtOnce];
    const float4* target[kViewsAtOnce];
};

constexpr int kBetweenGroups = 2;

// State that the blocks of a group share, without arrays.
struct FitTeam {
    unsigned arrived;  // number of arrivals at barriers
    unsigned unit, ticket;
    // Alternates within steps; the last element is used between groups.
    int cancel[kBetweenGroups + 1];
    uint32_t num_slots[kLargestTeam];  // slots in each block's part
    double error[kViewsAtOnce][2][2];  // errors of each block's views, before and after
};

// State of a block in shared memory, without arrays.
struct FitShared {
    FitCameras cameras[2];  // cameras of this step and the next
    FitTeam own;            // the team of a single block
    uint32_t warp_total[32];
    FitJob job;
    unsigned arrival;
    int cancel;
};

// A block that fits groups, one after another: its rank among the blocks that fit the
// same group, the barriers between them, and the locations of their arrays.
template <class Shape>
struct FitBlock : Shape {
    using Shape::kChunk, Shape::kSmall, Shape::kThreads, Shape::kWarps;
    using typename Shape::Index;

    const FitGroupsInput& in;
    const FitLayout& layout;
    FitShared& s;
    FitTeam& all;   // The blocks that fit the group; in a small group they share its views.
    FitTeam& team;  // The blocks that process the same views; a block of a small group is alone.
    const unsigned team_rank, team_size;
    const unsigned view_rank, view_stride;  // the block's share of a batch's views
    unsigned char* const scratch;
    // Gradients by view, for small groups whose blocks share the views.
    unsigned char* const exchange;
    unsigned char* const hot;
    // The current group.
    const FitJob& job;
    uint32_t n = 0, n_padded = 0;
    int num_sh = 0;
    uint32_t num_values = 0;
    int regions_across = 1;

    __device__ FitBlock(const FitGroupsInput& input, const FitLayout& l, FitShared& shared,
                        FitTeam* teams, unsigned num_blocks, unsigned char* all_scratch)
        : in(input),
          layout(l),
          s(shared),
          all(teams[s.arrival / num_blocks]),
          team(kSmall ? s.own : all),
          team_rank(kSmall ? 0 : s.arrival % num_blocks),
          team_size(kSmall ? 1 : num_blocks),
          view_rank(kSmall ? s.arrival % num_blocks : 0),
          view_stride(kSmall ? num_blocks : 1),
          scratch(all_scratch + (kSmall ? s.arrival : s.arrival / num_blocks) * l.scratch_bytes),
          exchange(all_scratch + (s.arrival - view_rank) * l.scratch_bytes + l.exchange),
          hot(kSmall ? shared_memory() : scratch),
          job(s.job) {}

    __device__ void begin_group(const FitJob& next) {
        if (threadIdx.x == 0) s.job = next;
        __syncthreads();
        n = static_cast<uint32_t>(job.group.count);
        n_padded = (n + 31) / 32 * 32;
        num_sh = 3 * num_sh_bases(in.rows.sh_degree);
        num_values = n * (11 + num_sh);
        regions_across = kSmall ? 1 : (job.size + kRegion - 1) / kRegion;
    }

    __device__ bool leads() const { return threadIdx.x == 0 && team_rank == 0; }
    __device__ bool leads_all() const { return leads() && view_rank == 0; }
    // Returns the index of a thread in the team; neighbouring warps are in different
    // blocks.
    __device__ uint32_t first() const {
        return (threadIdx.x / 32 * team_size + team_rank) * 32 + threadIdx.x % 32;
    }
    __device__ uint32_t stride() const { return kThreads * team_size; }

    __device__ unsigned num_blocks() const { return team_size * view_stride; }

    // Waits for all blocks that process the same views.
    __device__ void sync() const {
        if (team_size > 1)
            arrive_and_wait(-1);
        else
            __syncthreads();
    }

    // Waits for all blocks that fit the group. Afterwards s.cancel is the same in all
    // of them: the value that read_cancel() wrote to `note`, which must not be
    // overwritten before all blocks have reached another barrier.
    __device__ void sync_all(int note) const {
        if (num_blocks() > 1)
            arrive_and_wait(note);
        else
            __syncthreads();
    }
    __device__ void read_cancel(int note) const {
        int& cancel = num_blocks() > 1 ? all.cancel[note] : s.cancel;
        cancel = *static_cast<volatile int*>(&in.signals->cancel);
    }

    __device__ void arrive_and_wait(int note) const {
        __syncthreads();
        if (threadIdx.x == 0) {
            __threadfence();
            const unsigned goal = (atomicAdd(&all.arrived, 1u) / num_blocks() + 1) * num_blocks();
            while (*static_cast<volatile unsigned*>(&all.arrived) < goal) {
            }
            __threadfence();
            if (note >= 0) s.cancel = *static_cast<volatile int*>(&all.cancel[note]);
        }
        __syncthreads();
    }

    template <class T>
    __device__ T* hot_at(size_t offset) const {
        return reinterpret_cast<T*>(hot + offset);
    }
    __device__ float* at(const Place& place) const {
        return reinterpret_cast<float*>((place.is_shared ? shared_memory() : scratch) +
                                        place.offset);
    }
    // A place is the index of a gaussian in a view: places of view b begin at b *
    // n_padded. A rank is the index of a blended record. In a small group ranks are
    // places, and lists follow `order`; in a large one ranks are positions by depth, in
    // which the records are sorted.
    __device__ Record<float>* records() const { return hot_at<Record<float>>(layout.records); }
    __device__ Record<float>* ranked() const {
        return hot_at<Record<float>>(kSmall ? layout.records : layout.sorted);
    }
    __device__ uint32_t num_places() const { return kViewsAtOnce * n_padded; }
    // Returns the rank of an empty record.
    __device__ uint32_t nothing() const { return num_places(); }
    __device__ uint32_t* keys() const { return hot_at<uint32_t>(layout.keys); }
    __device__ Index* order() const { return hot_at<Index>(layout.order); }
    __device__ CellMask* mask(int region) const {
        return hot_at<CellMask>(layout.mask) + (kSmall ? 0 : region * num_places());
    }
    __device__ uint32_t* slot_first(int region) const {
        return hot_at<uint32_t>(layout.slot_first) + (kSmall ? 0 : region * num_places());
    }
    __device__ uint32_t warp() const { return team_rank * kWarps + threadIdx.x / 32; }
    __device__ Index* list(int half) const {
        return hot_at<Index>(layout.lists + (2 * warp() + half) * layout.list_size);
    }
    // Returns the gradients with respect to the exponent of each gaussian at each
    // pixel, and its weight there, [gaussian][pixel]. Rows have a spare column, so that
    // lanes that read the same pixel of different gaussians access different banks.
    __device__ float2* fragments() const {
        return reinterpret_cast<float2*>(shared_memory() + layout.fragments +
                                         threadIdx.x / 32 * fragments_bytes(kChunk));
    }
    __device__ float4* d_pixels() const {
        return reinterpret_cast<float4*>(fragments() + kChunk * 33);
    }
    // Returns the records of a chunk of a large group, for each half-warp.
    __device__ Record<float>* staged() const {
        return reinterpret_cast<Record<float>*>(shared_memory() + layout.staged) +
               2 * kChunk * (threadIdx.x / 32);
    }
    __device__ int num_regions() const { return regions_across * regions_across; }
    // Returns the gradients with respect to the values from view b of a batch. Blocks
    // that share views write the gradients of one batch while others may still read
    // those of the batch before, so two values of `turn` alternate.
    __device__ float* gradient(int turn, int b) const {
        if (view_stride == 1) return at(layout.by_view) + static_cast<size_t>(b) * num_values;
        return reinterpret_cast<float*>(exchange) +
               static_cast<size_t>(turn * kViewsAtOnce + b) * num_values;
    }
};

}  // namespace cuda
}  // namespace v3dg

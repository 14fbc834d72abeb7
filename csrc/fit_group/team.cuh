#pragma once

// The blocks that fit a group together, and their memory.
//
// Small groups keep frequently read arrays in shared memory. Usually, one block fits a
// small group; if there are few groups, two blocks fit it, each of them half of the
// views. The arrays of large groups are in global memory. If there are fewer large
// groups than multiprocessors, a team of blocks fits each of them.

#include "base/launch.cuh"
#include "fit_group/fit_group_math.h"
#include "fit_group/fit_memory.h"

namespace v3dg {
namespace cuda {

constexpr unsigned kLargestTeam = 16;

// The views that a block processes together.
struct FitCameras {
    FitStep step;  // the step that the views belong to
    ModelView<float> view[kViewsAtOnce];
    Pinhole<float> camera[kViewsAtOnce];
    const float4* target[kViewsAtOnce];
};

constexpr int kBetweenGroups = 2;

// Variables that the blocks of a group share. FitLayout has the locations of their
// arrays.
struct FitTeam {
    unsigned arrived;  // number of arrivals at barriers
    unsigned unit, ticket;
    // Copies of FitSignals::cancel. Steps use the first elements in turn, so that one
    // can be read while the next is written. The last element is used between groups.
    int cancel[kBetweenGroups + 1];
    uint32_t num_slots[kLargestTeam];  // number of slots in each block's part
    // [view][initial values, result][colour, alpha] errors in the block's views.
    double error[kViewsAtOnce][2][2];
};

// Variables of a block in shared memory. FitLayout has the locations of its arrays.
struct FitShared {
    FitCameras cameras[2];  // for the current batch of views, and for the next
    FitTeam own;            // used if the team is a single block
    uint32_t warp_total[32];
    FitJob job;
    unsigned arrival;
    int cancel;
};

// A block that fits groups, one after another. It has the block's rank among the blocks
// of its group, the barriers between them, and the locations of their arrays.
template <class Shape>
struct FitBlock : Shape {
    using Shape::kChunk, Shape::kSmall, Shape::kThreads, Shape::kWarps;
    using typename Shape::Index;

    const FitGroupsInput& in;
    const FitLayout& layout;
    FitShared& s;
    // Shared by all blocks of the group. In a small group, the blocks divide the views.
    FitTeam& all;
    // Shared by the blocks that process the same views. In a small group, each block is
    // a team of its own.
    FitTeam& team;
    const unsigned team_rank, team_size;
    // Of a batch, the block processes the views view_rank, view_rank + view_stride, and
    // so on.
    const unsigned view_rank, view_stride;
    unsigned char* const scratch;
    // Gradients per view, for small groups that are fitted by several blocks.
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
    // Returns the thread's index in the team. Consecutive warps belong to different
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

    // Waits for all blocks of the group. Afterwards, s.cancel is the same in all of
    // them: the value that read_cancel() wrote to element `note`. This element must not
    // be overwritten before all blocks have reached another barrier.
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
    // A place is the index of a gaussian in a view; the places of view b begin at b *
    // n_padded. A rank is the index of a record for blending. In a small group, ranks
    // are places, and `order` gives the sequence of the lists. In a large group,
    // records are sorted, and ranks are positions in the sorted sequence.
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
    // Returns the fragments of a warp, [gaussian][pixel]. A fragment has the gradient
    // with respect to the exponent, and the weight. Rows have an extra column, so that
    // lanes that read the same pixel of different gaussians access different banks.
    __device__ float2* fragments() const {
        return reinterpret_cast<float2*>(shared_memory() + layout.fragments +
                                         threadIdx.x / 32 * fragments_bytes(kChunk));
    }
    __device__ float4* d_pixels() const {
        return reinterpret_cast<float4*>(fragments() + kChunk * 33);
    }
    // Returns the records of the current chunk of each half-warp. Only for large
    // groups.
    __device__ Record<float>* staged() const {
        return reinterpret_cast<Record<float>*>(shared_memory() + layout.staged) +
               2 * kChunk * (threadIdx.x / 32);
    }
    __device__ int num_regions() const { return regions_across * regions_across; }
    // Returns the gradients of the parameters in view b of a batch. `turn` alternates
    // between two buffers: if several blocks divide the views, one block may write the
    // gradients of a batch while another still reads those of the previous batch.
    __device__ float* gradient(int turn, int b) const {
        if (view_stride == 1) return at(layout.by_view) + static_cast<size_t>(b) * num_values;
        return reinterpret_cast<float*>(exchange) +
               static_cast<size_t>(turn * kViewsAtOnce + b) * num_values;
    }
};

}  // namespace cuda
}  // namespace v3dg

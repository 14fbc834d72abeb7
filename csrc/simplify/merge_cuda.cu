// Merging on CUDA. A block merges one group, in several rounds. The nodes of a group
// are in device memory; there are only some hundreds of them, so they stay in the
// caches. To search for partners, they are loaded into shared memory in tiles.

#include <algorithm>
#include <cfloat>

#include "base/launch.cuh"
#include "simplify/simplify.h"
#include "simplify/simplify_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kBlockSize = 256, kWarps = kBlockSize / 32;
constexpr int kTileSize = 128;  // number of nodes in shared memory
constexpr int64_t kMostRows = int64_t(1)
                              // Maximum number of rows that are merged together. They
                              // need 350 MiB of scratch memory.
                              << 21;

// The scratch memory of a group, with one element per row.
struct Scratch {
    MergeNode* nodes;
    double* row_weight;
    MergePair *pairs, *sorted;
    int *alive, *next,
        // A node stores the index of its first row. Its other rows follow in a linked
        // list.
        *last;
    uint8_t* is_used;

    __device__ Scratch at(int64_t row) const {
        return {.nodes = nodes + row,
                .row_weight = row_weight + row,
                .pairs = pairs + row,
                .sorted = sorted + row,
                .alive = alive + row,
                .next = next + row,
                .last = last + row,
                .is_used = is_used + row};
    }
};

// Turns each row into a node. Returns inverse_spacing2_of() for the group.
__device__ double start_nodes(const GaussianRows<const float>& in, int64_t first, int count,
                              int64_t wanted, const Scratch& group) {
    double low[3] = {DBL_MAX, DBL_MAX, DBL_MAX}, minus_high[3] = {DBL_MAX, DBL_MAX, DBL_MAX};
    for (int i = threadIdx.x; i < count; i += kBlockSize) {
        const MergeNode node = merge_node_of(in, first + i);
        group.nodes[i] = node;
        group.row_weight[i] = node.feature.weight;
        group.alive[i] = group.last[i] = i;
        group.next[i] = -1;
        for (int k = 0; k < 3; ++k) {
            low[k] = fmin(low[k], node.feature.mean[k]);
            minus_high[k] = fmin(minus_high[k], -node.feature.mean[k]);
        }
    }
    __shared__ double low_of_warp[6][kWarps];
    for (int k = 0; k < 3; ++k) {
        const double least = warp_min(low[k]), greatest = warp_min(minus_high[k]);
        if (threadIdx.x % 32 == 0) {
            low_of_warp[k][threadIdx.x / 32] = least;
            low_of_warp[3 + k][threadIdx.x / 32] = greatest;
        }
    }
    __syncthreads();
    for (int k = 0; k < 3; ++k) {
        low[k] = low_of_warp[k][0];
        minus_high[k] = low_of_warp[3 + k][0];
        for (int w = 1; w < kWarps; ++w) {
            low[k] = fmin(low[k], low_of_warp[k][w]);
            minus_high[k] = fmin(minus_high[k], low_of_warp[3 + k][w]);
        }
    }
    const double high[3] = {-minus_high[0], -minus_high[1], -minus_high[2]};
    return inverse_spacing2_of(low, high, wanted);
}

// Finds, for each of n nodes, the partner with the lowest cost.
__device__ void find_partners(const Scratch& group, int n, double inverse_spacing2) {
    __shared__ MergeFeature tile[kTileSize];
    for (int base = 0; base < n; base += kBlockSize) {
        const int i = base + static_cast<int>(threadIdx.x);
        MergeFeature mine{};
        if (i < n) mine = group.nodes[group.alive[i]].feature;
        double cheapest = INFINITY;
        int partner = i == 0 ? 1 : 0;
        for (int first = 0; first < n; first += kTileSize) {
            __syncthreads();
            if (threadIdx.x < kTileSize && first + static_cast<int>(threadIdx.x) < n)
                tile[threadIdx.x] = group.nodes[group.alive[first + threadIdx.x]].feature;
            __syncthreads();
            const int size = n - first < kTileSize ? n - first : kTileSize;
            if (i >= n) continue;
            for (int k = 0; k < size; ++k) {
                const double cost = merge_cost(mine, tile[k], inverse_spacing2);
                if (cost < cheapest && first + k != i) {
                    cheapest = cost;
                    partner = first + k;
                }
            }
        }
        if (i < n)
            group.pairs[i] = {cheapest, i < partner ? i : partner, i < partner ? partner : i};
    }
}

// Sorts the pairs. The position of a pair is the number of pairs that come before it.
__device__ void sort_pairs(const Scratch& group, int n) {
    __shared__ MergePair tile[kBlockSize];
    for (int base = 0; base < n; base += kBlockSize) {
        const int i = base + static_cast<int>(threadIdx.x);
        MergePair mine{};
        if (i < n) mine = group.pairs[i];
        int place = 0;
        for (int first = 0; first < n; first += kBlockSize) {
            __syncthreads();
            if (first + static_cast<int>(threadIdx.x) < n)
                tile[threadIdx.x] = group.pairs[first + threadIdx.x];
            __syncthreads();
            const int size = n - first < kBlockSize ? n - first : kBlockSize;
            if (i >= n) continue;
            for (int k = 0; k < size; ++k)
                place += is_before(tile[k], mine) || (first + k < i && !is_before(mine, tile[k]));
        }
        if (i < n) {
            group.sorted[place] = mine;
            group.is_used[i] = 0;
        }
    }
}

// Chooses at most `allowed` of the sorted pairs. A pair is chosen if it shares no node
// with an earlier chosen pair. Moves the chosen pairs to the front of `pairs`, and
// returns their number. Must be called by one warp.
__device__ int choose_pairs(const Scratch& group, int n, int64_t allowed) {
    const int lane = static_cast<int>(threadIdx.x % 32);
    int chosen = 0;
    for (int first = 0; first < n && chosen < allowed; first += 32) {
        MergePair pair{0, -1, -1};
        bool is_free = false;
        if (first + lane < n) {
            pair = group.sorted[first + lane];
            is_free = !group.is_used[pair.a] && !group.is_used[pair.b];
        }
        for (unsigned left = __ballot_sync(kAllLanes, is_free); left != 0 && chosen < allowed;
             left = __ballot_sync(kAllLanes, is_free)) {
            const int source = __ffs(static_cast<int>(left)) - 1;
            const int a = __shfl_sync(kAllLanes, pair.a, source);
            const int b = __shfl_sync(kAllLanes, pair.b, source);
            if (lane == source) {
                group.pairs[chosen] = pair;
                group.is_used[a] = group.is_used[b] = 1;
            }
            is_free = is_free && pair.a != a && pair.a != b && pair.b != a && pair.b != b;
            ++chosen;
        }
        __syncwarp();
    }
    return chosen;
}

// Joins the chosen pairs, and marks the nodes that disappear.
__device__ void join_pairs(const Scratch& group, int num_pairs) {
    for (int j = threadIdx.x; j < num_pairs; j += kBlockSize) {
        const MergePair pair = group.pairs[j];
        const int a = group.alive[pair.a], b = group.alive[pair.b];
        MergeNode node = group.nodes[a];
        join(node, group.nodes[b]);
        group.nodes[a] = node;
        group.next[group.last[a]] = b;
        group.last[a] = group.last[b];
        group.alive[pair.b] = -1;
    }
}

// Removes the nodes that have disappeared from the list. Must be called by one warp.
__device__ void drop_joined(const Scratch& group, int n) {
    const int lane = static_cast<int>(threadIdx.x % 32);
    int num_kept = 0;
    for (int first = 0; first < n; first += 32) {
        const int node = first + lane < n ? group.alive[first + lane] : -1;
        const unsigned alive = __ballot_sync(kAllLanes, node >= 0);
        if (node >= 0) group.alive[num_kept + __popc(alive & ((1u << lane) - 1))] = node;
        num_kept += __popc(alive);
        __syncwarp();
    }
}

__device__ void write_rows(const GaussianRows<const float>& in, int64_t first, const Scratch& group,
                           int n, const GaussianRows<float>& out, int64_t to) {
    for (int i = threadIdx.x; i < n; i += kBlockSize) {
        const int node = group.alive[i];
        if (group.next[node] < 0)
            copy_shape(in, first + node, out, to + i);
        else
            write_joined(group.nodes[node], out, to + i);
    }
    for (int64_t item = threadIdx.x; item < int64_t(n) * in.num_sh(); item += kBlockSize) {
        const int i = static_cast<int>(item / in.num_sh()),
                  k = static_cast<int>(item % in.num_sh());
        const int node = group.alive[i];
        float value = in.sh[in.num_sh() * (first + node) + k];
        if (group.next[node] >= 0) {
            double sum = 0;
            for (int row = node; row >= 0; row = group.next[row])
                sum += group.row_weight[row] * in.sh[in.num_sh() * (first + row) + k];
            value = static_cast<float>(sum / group.nodes[node].feature.weight);
        }
        out.sh[in.num_sh() * (to + i) + k] = value;
    }
}

__global__ void __launch_bounds__(kBlockSize)
    merge_kernel(GaussianRows<const float> in, const int64_t* in_offset, const int64_t* out_offset,
                 size_t first_group, Scratch scratch, GaussianRows<float> out) {
    const size_t g = first_group + blockIdx.x;
    const int64_t first = in_offset[g], wanted = out_offset[g + 1] - out_offset[g];
    int n = static_cast<int>(in_offset[g + 1] - first);
    const Scratch group = scratch.at(first - in_offset[first_group]);
    const double inverse_spacing2 = start_nodes(in, first, n, wanted, group);
    __shared__ int num_pairs;
    // In each round, every node finds its cheapest partner. Then the cheapest disjoint
    // pairs are joined.
    while (n > wanted) {
        __syncthreads();
        find_partners(group, n, inverse_spacing2);
        __syncthreads();
        sort_pairs(group, n);
        __syncthreads();
        if (threadIdx.x < 32) {
            const int chosen = choose_pairs(group, n, pairs_in_round(n, wanted));
            if (threadIdx.x == 0) num_pairs = chosen;
        }
        __syncthreads();
        join_pairs(group, num_pairs);
        __syncthreads();
        if (threadIdx.x < 32) drop_joined(group, n);
        n -= num_pairs;
    }
    __syncthreads();
    write_rows(in, first, group, n, out, out_offset[g]);
}

}  // namespace

void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out, Stream stream) {
    const size_t num_groups = in_offset.size - 1;
    // A run is a range of groups that share the scratch memory.
    const auto end_of_run = [&](size_t first) {
        size_t last = first + 1;
        while (last < num_groups && in_offset[last + 1] - in_offset[first] <= kMostRows) ++last;
        return last;
    };
    int64_t rows = 0;
    for (size_t first = 0; first < num_groups; first = end_of_run(first))
        rows = std::max(rows, in_offset[end_of_run(first)] - in_offset[first]);
    const DeviceBuffer<int64_t> in_offsets(in_offset, stream), out_offsets(out_offset, stream);
    DeviceBuffer<MergeNode> nodes(rows, stream);
    DeviceBuffer<double> row_weight(rows, stream);
    DeviceBuffer<MergePair> pairs(rows, stream), sorted(rows, stream);
    DeviceBuffer<int> alive(rows, stream), next(rows, stream), last(rows, stream);
    DeviceBuffer<uint8_t> is_used(rows, stream);
    const Scratch scratch{.nodes = nodes.data(),
                          .row_weight = row_weight.data(),
                          .pairs = pairs.data(),
                          .sorted = sorted.data(),
                          .alive = alive.data(),
                          .next = next.data(),
                          .last = last.data(),
                          .is_used = is_used.data()};
    for (size_t first = 0; first < num_groups; first = end_of_run(first))
        launch("merge", merge_kernel, static_cast<unsigned>(end_of_run(first) - first), kBlockSize,
               0, stream, in, in_offsets.data(), out_offsets.data(), first, scratch, out);
}

}  // namespace cuda
}  // namespace v3dg

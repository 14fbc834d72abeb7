// The median split on CUDA. It processes one level of the tree at a time, with all
// nodes together.
//
// There are four lists of point indices. Three of them are sorted, within each node, by
// x, y and z (equal coordinates by index). The fourth is sorted by index. Therefore the
// extent of a node is the difference of two values, and its median is in the middle of
// a list. A split is a stable partition of all lists. At the end, the fourth list has
// the order within the leaves.

#include <cub/device/device_radix_sort.cuh>

#include <utility>
#include <vector>

#include "base/scan.cuh"
#include "cluster/cluster.h"
#include "math/ascending_bits.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kNumLists = 4, kByIndex = 3;  // list l begins at l * count
constexpr unsigned kBlockSize = 256;
// A block partitions one tile of a list, and a warp processes 32 points at a time.
constexpr unsigned kWordsPerTile = 64;
constexpr unsigned kTileSize = 32 * kWordsPerTile;

// A node has the positions first to last in every list. Its left half ends at `middle`.
struct Node {
    uint32_t first, middle, last;
    uint32_t lefts_before;  // number of points in the left halves of all earlier nodes
};

// Returns the last of the nodes `low` to `high` that begins at or before `position`.
// That node is never empty.
__device__ uint32_t node_at(const Node* nodes, uint32_t low, uint32_t high, size_t position) {
    while (low < high) {
        const uint32_t middle = low + (high - low + 1) / 2;
        if (nodes[middle].first <= position)
            low = middle;
        else
            high = middle - 1;
    }
    return low;
}

// The nodes of the first and the last position of a tile. All threads of the block must
// call nodes_of_tile().
struct NodeRange {
    uint32_t low, high;
};
__device__ NodeRange nodes_of_tile(const Node* nodes, uint32_t num_nodes, size_t tile,
                                   size_t count) {
    __shared__ uint32_t found[2];
    if (threadIdx.x < 2) {
        const size_t last = (tile + 1) * kTileSize < count ? (tile + 1) * kTileSize - 1 : count - 1;
        found[threadIdx.x] =
            node_at(nodes, 0, num_nodes - 1, threadIdx.x == 0 ? tile * kTileSize : last);
    }
    __syncthreads();
    return {found[0], found[1]};
}

// Computes keys for sorting along one axis, from the segment and the coordinate. -0 and
// 0 have equal keys.
__global__ void keys_kernel(const Point* means, size_t count, const Node* segments,
                            uint32_t num_segments, int axis, uint64_t* keys, uint32_t* indices) {
    const size_t i = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (i >= count) return;
    keys[i] = uint64_t(node_at(segments, 0, num_segments - 1, i)) << 32 |
              ascending_bits(means[i].axis[axis]);
    indices[i] = static_cast<uint32_t>(i);
}

__global__ void iota_kernel(size_t count, uint32_t* indices) {
    const size_t i = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (i < count) indices[i] = static_cast<uint32_t>(i);
}

__global__ void longest_axis_kernel(const Point* means, const Node* nodes, uint32_t num_nodes,
                                    const uint32_t* lists, size_t count, uint8_t* axis_of_node) {
    const size_t n = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (n >= num_nodes) return;
    const Node node = nodes[n];
    int longest = 0;
    float longest_extent = 0;
    for (int a = 0; a < 3 && node.first < node.last; ++a) {
        const float low = means[lists[a * count + node.first]].axis[a];
        const float high = means[lists[a * count + node.last - 1]].axis[a];
        const float extent = high - low;
        if (a == 0 || extent > longest_extent) {
            longest = a;
            longest_extent = extent;
        }
    }
    axis_of_node[n] = static_cast<uint8_t>(longest);
}

// For each point, computes whether it goes to the left half of its node.
__global__ void side_kernel(const Node* nodes, uint32_t num_nodes, const uint8_t* axis_of_node,
                            const uint32_t* lists, size_t count, uint8_t* goes_left) {
    const NodeRange range = nodes_of_tile(nodes, num_nodes, blockIdx.x, count);
    for (unsigned k = threadIdx.x; k < kTileSize; k += kBlockSize) {
        const size_t position = blockIdx.x * size_t(kTileSize) + k;
        if (position >= count) return;
        const uint32_t n = node_at(nodes, range.low, range.high, position);
        goes_left[lists[axis_of_node[n] * count + position]] = position < nodes[n].middle;
    }
}

// Writes, for each list in its order, which half each point goes to, with one bit per
// position. Also counts the points of each tile that go to the left half.
__global__ void count_kernel(const uint32_t* lists, unsigned first_list, size_t count,
                             const uint8_t* goes_left, uint32_t* words, uint32_t* tile_lefts) {
    const size_t list = first_list + blockIdx.y;
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    __shared__ uint32_t lefts_of_warp[kBlockSize / 32];
    uint32_t lefts = 0;
    for (unsigned k = warp; k < kWordsPerTile; k += kBlockSize / 32) {
        const size_t word = blockIdx.x * size_t(kWordsPerTile) + k, position = word * 32 + lane;
        const bool left = position < count && goes_left[lists[list * count + position]] != 0;
        const uint32_t bits = __ballot_sync(kAllLanes, left);
        if (lane == 0) words[list * gridDim.x * kWordsPerTile + word] = bits;
        lefts += __popc(bits);
    }
    if (lane == 0) lefts_of_warp[warp] = lefts;
    __syncthreads();
    if (threadIdx.x == 0) {
        uint32_t sum = 0;
        for (unsigned w = 0; w < kBlockSize / 32; ++w) sum += lefts_of_warp[w];
        tile_lefts[list * gridDim.x + blockIdx.x] = sum;
    }
}

// Replaces the counts of each list's tiles by prefix sums. Launched with one block per
// list.
__global__ void sum_kernel(uint32_t num_tiles, unsigned first_list, uint32_t* tile_lefts) {
    uint32_t* values = tile_lefts + size_t(first_list + blockIdx.x) * num_tiles;
    uint32_t before = 0;
    for (uint32_t first = 0; first < num_tiles; first += blockDim.x) {
        const uint32_t i = first + threadIdx.x;
        uint32_t total;
        const uint32_t sum = block_prefix(i < num_tiles ? values[i] : 0, total);
        if (i < num_tiles) values[i] = before + sum;
        before += total;
    }
}

// Moves each point to its half of its node, and preserves the order of the list.
__global__ void partition_kernel(const Node* nodes, uint32_t num_nodes, const uint32_t* from,
                                 uint32_t* to, unsigned first_list, size_t count,
                                 const uint32_t* words, const uint32_t* tile_lefts) {
    const size_t list = first_list + blockIdx.y;
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    __shared__ uint32_t word_bits[kWordsPerTile], lefts_before_word[kWordsPerTile];
    const bool has_word = threadIdx.x < kWordsPerTile;
    const uint32_t bits =
        has_word ? words[(list * gridDim.x + blockIdx.x) * kWordsPerTile + threadIdx.x] : 0;
    uint32_t total;
    const uint32_t before =
        tile_lefts[list * gridDim.x + blockIdx.x] + block_prefix<uint32_t>(__popc(bits), total);
    if (has_word) {
        word_bits[threadIdx.x] = bits;
        lefts_before_word[threadIdx.x] = before;
    }
    const NodeRange range = nodes_of_tile(nodes, num_nodes, blockIdx.x, count);
    for (unsigned k = warp; k < kWordsPerTile; k += kBlockSize / 32) {
        const size_t position = blockIdx.x * size_t(kTileSize) + k * 32 + lane;
        if (position >= count) return;
        const Node node = nodes[node_at(nodes, range.low, range.high, position)];
        const uint32_t lefts = lefts_before_word[k] + __popc(word_bits[k] & ((1u << lane) - 1));
        const uint32_t left_rank = lefts - node.lefts_before;
        const bool left = (word_bits[k] >> lane & 1) != 0;
        const uint32_t place =
            left ? node.first + left_rank
                 : node.middle + (static_cast<uint32_t>(position) - node.first - left_rank);
        to[list * count + place] = from[list * count + position];
    }
}

__global__ void widen_kernel(const uint32_t* from, size_t count, int64_t* to) {
    const size_t i = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (i < count) to[i] = from[i];
}

// Returns the nodes of all levels, from the root down.
std::vector<Node> nodes_of_levels(Span<const int64_t> leaf_offset, int depth) {
    const size_t num_leaves = leaf_offset.size - 1;
    std::vector<Node> nodes;
    nodes.reserve(num_leaves);
    for (size_t width = size_t(1) << depth; width > 1; width /= 2) {
        uint32_t lefts = 0;
        for (size_t leaf = 0; leaf < num_leaves; leaf += width) {
            const Node node{.first = static_cast<uint32_t>(leaf_offset[leaf]),
                            .middle = static_cast<uint32_t>(leaf_offset[leaf + width / 2]),
                            .last = static_cast<uint32_t>(leaf_offset[leaf + width]),
                            .lefts_before = lefts};
            nodes.push_back(node);
            lefts += node.middle - node.first;
        }
    }
    return nodes;
}

// Sorts the points of each segment along each of the three axes.
void sort_lists(const Point* means, size_t count, const Node* segments, uint32_t num_segments,
                uint32_t* lists, cudaStream_t stream) {
    DeviceBuffer<uint64_t> keys(count, stream), sorted_keys(count, stream);
    DeviceBuffer<uint32_t> indices(count, stream);
    int num_bits = 32;
    while (num_bits < 64 && (uint64_t(num_segments - 1) >> (num_bits - 32)) != 0) ++num_bits;
    const auto sort = [&](void* scratch, size_t& bytes, uint32_t* list) {
        check(cub::DeviceRadixSort::SortPairs(scratch, bytes, keys.data(), sorted_keys.data(),
                                              indices.data(), list, count, 0, num_bits, stream),
              "median_split: sort");
    };
    size_t bytes = 0;
    sort(nullptr, bytes, nullptr);
    DeviceBuffer<unsigned char> scratch(bytes, stream);
    const unsigned blocks = blocks_for(count, kBlockSize);
    for (int axis = 0; axis < 3; ++axis) {
        launch("median_split: keys", keys_kernel, blocks, kBlockSize, 0, stream, means, count,
               segments, num_segments, axis, keys.data(), indices.data());
        sort(scratch.data(), bytes, lists + axis * count);
    }
}

}  // namespace

void median_split(Span<const Point> means, Span<const int64_t> offset, int depth, size_t unit,
                  Span<int64_t> order, Span<int64_t> leaf_offset, Stream stream) {
    halve_segments(offset, depth, unit, leaf_offset);
    const size_t count = means.size;
    if (count == 0) return;
    const unsigned blocks = blocks_for(count, kBlockSize);
    DeviceBuffer<uint32_t> buffer(kNumLists * count, stream),
        next_buffer(kNumLists * count, stream);
    uint32_t *lists = buffer.data(), *next = next_buffer.data();
    const std::vector<Node> host_nodes = nodes_of_levels(leaf_offset, depth);
    const DeviceBuffer<Node> all_nodes(Span<const Node>{host_nodes.data(), host_nodes.size()},
                                       stream);
    const Node* nodes = all_nodes.data();
    uint32_t num_nodes = static_cast<uint32_t>(offset.size - 1);
    if (depth > 0) sort_lists(means.data, count, nodes, num_nodes, lists, stream);
    launch("median_split: by index", iota_kernel, blocks, kBlockSize, 0, stream, count,
           lists + kByIndex * count);

    const unsigned tiles = blocks_for(count, kTileSize);
    DeviceBuffer<uint8_t> goes_left(count, stream), axis_of_node(leaf_offset.size / 2, stream);
    DeviceBuffer<uint32_t> words(kNumLists * size_t(tiles) * kWordsPerTile, stream);
    DeviceBuffer<uint32_t> tile_lefts(kNumLists * size_t(tiles), stream);
    for (int level = 0; level < depth; ++level) {
        // After the last split, the lists along the axes are no longer needed.
        const unsigned first_list = level + 1 == depth ? kByIndex : 0;
        const unsigned num_lists = kNumLists - first_list;
        launch("median_split: longest axis", longest_axis_kernel, blocks_for(num_nodes, kBlockSize),
               kBlockSize, 0, stream, means.data, nodes, num_nodes, lists, count,
               axis_of_node.data());
        launch("median_split: sides", side_kernel, tiles, kBlockSize, 0, stream, nodes, num_nodes,
               axis_of_node.data(), lists, count, goes_left.data());
        launch("median_split: count", count_kernel, dim3(tiles, num_lists), kBlockSize, 0, stream,
               lists, first_list, count, goes_left.data(), words.data(), tile_lefts.data());
        launch("median_split: sum", sum_kernel, num_lists, 1024, 0, stream, tiles, first_list,
               tile_lefts.data());
        launch("median_split: partition", partition_kernel, dim3(tiles, num_lists), kBlockSize, 0,
               stream, nodes, num_nodes, lists, next, first_list, count, words.data(),
               tile_lefts.data());
        std::swap(lists, next);
        nodes += num_nodes;
        num_nodes *= 2;
    }
    launch("median_split: widen", widen_kernel, blocks, kBlockSize, 0, stream,
           lists + kByIndex * count, count, order.data);
}

}  // namespace cuda
}  // namespace v3dg

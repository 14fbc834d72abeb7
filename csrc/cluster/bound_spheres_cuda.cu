// Computes bounding balls on CUDA. All segments are processed in lockstep. In each
// pass, blocks find the sphere of each segment that extends farthest from the current
// centre. One warp per segment then adds this sphere to the core set and moves the
// centre. A finished segment only costs the test of a flag.

#include <vector>

#include "base/launch.cuh"
#include "cluster/cluster.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128, kWarps = kBlockSize / 32;
constexpr size_t kChunkSize = 4096;  // number of spheres that a block searches
static_assert(kCoreSize <= 32, "each of 32 lanes holds one sphere of the core set");

enum class Phase : int { search, measure, done };

struct Search {
    Center center;  // the current centre
    Center best;
    double best_radius, core_radius;
    int core_size;
    Phase phase;
};

// A sphere of a segment, and the distance of its farthest point. If distances are
// equal, the sphere with the lower index is chosen.
struct Farthest {
    double distance;
    uint32_t index;
};

__device__ Farthest farther(const Farthest& a, const Farthest& b) {
    return b.distance > a.distance || (b.distance == a.distance && b.index < a.index) ? b : a;
}

__device__ Farthest farthest_of_warp(Farthest mine) {
    for (int step = 16; step > 0; step /= 2) {
        const Farthest other{__shfl_xor_sync(kAllLanes, mine.distance, step),
                             __shfl_xor_sync(kAllLanes, mine.index, step)};
        mine = farther(mine, other);
    }
    return mine;
}

__global__ void start_kernel(const Ball* spheres, const int64_t* offset, size_t num_segments,
                             Search* searches, Ball* balls) {
    const size_t s = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (s >= num_segments) return;
    const int64_t count = offset[s + 1] - offset[s];
    Search search{};
    search.phase = count == 0 ? Phase::done : count == 1 ? Phase::measure : Phase::search;
    balls[s] = {0, 0, 0, kMinRadius};
    if (count > 0) search.center = search.best = center_of(spheres[offset[s]]);
    searches[s] = search;
}

// Launched with one block per chunk of a segment.
__global__ void farthest_kernel(const Ball* spheres, const int64_t* offset,
                                const uint32_t* segment_of_chunk, const uint32_t* first_chunk,
                                const Search* searches, Farthest* found) {
    const uint32_t s = segment_of_chunk[blockIdx.x];
    if (searches[s].phase == Phase::done) return;
    const Center center = searches[s].center;
    const Ball* segment = spheres + offset[s];
    const size_t count = static_cast<size_t>(offset[s + 1] - offset[s]);
    const size_t first = (blockIdx.x - first_chunk[s]) * kChunkSize;
    const size_t last = first + kChunkSize < count ? first + kChunkSize : count;
    Farthest best{-1.0, 0};
    for (size_t i = first + threadIdx.x; i < last; i += kBlockSize) {
        const double distance = reach(center, segment[i]);
        if (distance > best.distance) best = {distance, static_cast<uint32_t>(i)};
    }
    best = farthest_of_warp(best);
    __shared__ Farthest of_warp[kWarps];
    if (threadIdx.x % 32 == 0) of_warp[threadIdx.x / 32] = best;
    __syncthreads();
    if (threadIdx.x == 0) {
        for (unsigned w = 1; w < kWarps; ++w) best = farther(best, of_warp[w]);
        found[blockIdx.x] = best;
    }
}

// Moves `center` towards the centre of the smallest ball around a core set. The first
// `count` lanes each hold one sphere of it. Returns the radius of that ball.
__device__ double center_core(const Ball& mine, int count, Center& center) {
    const unsigned lane = threadIdx.x % 32;
    const auto find = [&](const Center& place) {
        const bool counts = static_cast<int>(lane) < count;
        return farthest_of_warp({counts ? reach(place, mine) : -1.0, lane});
    };
    Center place = center;
    Farthest far = find(place);
    double best_radius = far.distance;
    for (int step = kFirstCoreStep; step <= kLastCoreStep; ++step) {
        const Ball sphere{__shfl_sync(kAllLanes, mine.x, far.index),
                          __shfl_sync(kAllLanes, mine.y, far.index),
                          __shfl_sync(kAllLanes, mine.z, far.index),
                          __shfl_sync(kAllLanes, mine.radius, far.index)};
        if (!move_center(sphere, far.distance, step, place)) break;
        far = find(place);
        if (far.distance < best_radius) {
            best_radius = far.distance;
            center = place;
        }
    }
    return best_radius;
}

// Performs one pass for each segment. Launched with one warp per segment.
__global__ void advance_kernel(const Ball* spheres, const int64_t* offset, size_t num_segments,
                               const uint32_t* first_chunk, const Farthest* found, double margin,
                               Search* searches, Ball* cores, Ball* balls) {
    const size_t s = blockIdx.x * size_t(kWarps) + threadIdx.x / 32;
    if (s >= num_segments) return;
    Search search = searches[s];
    if (search.phase == Phase::done) return;
    const unsigned lane = threadIdx.x % 32;
    Farthest far{-1.0, 0};
    for (uint32_t c = first_chunk[s] + lane; c < first_chunk[s + 1]; c += 32)
        far = farther(far, found[c]);
    far = farthest_of_warp(far);

    if (search.phase == Phase::measure) {
        Ball ball = ball_at(search.best);
        ball.radius = radius_of_ball(far.distance, margin);
        search.phase = Phase::done;
        if (lane == 0) {
            balls[s] = ball;
            searches[s] = search;
        }
        return;
    }
    Ball* core = cores + s * kCoreSize;
    Ball mine{};
    if (static_cast<int>(lane) < search.core_size) mine = core[lane];
    if (search.core_size == 0) {
        search.best_radius = far.distance;
        if (lane == 0) mine = spheres[offset[s]];
        search.core_size = 1;
    } else {
        if (far.distance < search.best_radius) {
            search.best_radius = far.distance;
            search.best = search.center;
        }
        if (core_suffices(far.distance, search.core_radius, search.core_size)) {
            search.phase = Phase::measure;
            search.center = center_of(ball_at(search.best));
            if (lane == 0) searches[s] = search;
            return;
        }
    }
    if (static_cast<int>(lane) == search.core_size) mine = spheres[offset[s] + far.index];
    ++search.core_size;
    if (static_cast<int>(lane) < search.core_size) core[lane] = mine;
    search.core_radius = center_core(mine, search.core_size, search.center);
    if (lane == 0) searches[s] = search;
}

}  // namespace

void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball, Stream stream) {
    const size_t num_segments = ball.size;
    std::vector<uint32_t> first_chunk{0}, segment_of_chunk;
    for (size_t s = 0; s < num_segments; ++s) {
        const size_t chunks = (offset[s + 1] - offset[s] + kChunkSize - 1) / kChunkSize;
        segment_of_chunk.insert(segment_of_chunk.end(), chunks, static_cast<uint32_t>(s));
        first_chunk.push_back(static_cast<uint32_t>(segment_of_chunk.size()));
    }
    const DeviceBuffer<int64_t> offsets(offset, stream);
    const DeviceBuffer<uint32_t> first_chunks(
        Span<const uint32_t>{first_chunk.data(), first_chunk.size()}, stream);
    const DeviceBuffer<uint32_t> segments(
        Span<const uint32_t>{segment_of_chunk.data(), segment_of_chunk.size()}, stream);
    DeviceBuffer<Search> searches(num_segments, stream);
    DeviceBuffer<Ball> cores(num_segments * kCoreSize, stream);
    DeviceBuffer<Farthest> farthest_of_chunk(segment_of_chunk.size(), stream);
    launch("bound_spheres: start", start_kernel, blocks_for(num_segments, kBlockSize), kBlockSize,
           0, stream, spheres.data, offsets.data(), num_segments, searches.data(), ball.data);
    // The core set initially has two spheres, and gets one more per pass. Two more
    // passes measure the core set and compute the radius.
    for (int pass = 0; pass < kCoreSize + 1; ++pass) {
        launch("bound_spheres: farthest", farthest_kernel,
               static_cast<unsigned>(segment_of_chunk.size()), kBlockSize, 0, stream, spheres.data,
               offsets.data(), segments.data(), first_chunks.data(), searches.data(),
               farthest_of_chunk.data());
        launch("bound_spheres: advance", advance_kernel, blocks_for(num_segments, kWarps),
               kBlockSize, 0, stream, spheres.data, offsets.data(), num_segments,
               first_chunks.data(), farthest_of_chunk.data(), margin, searches.data(), cores.data(),
               ball.data);
    }
}

}  // namespace cuda
}  // namespace v3dg

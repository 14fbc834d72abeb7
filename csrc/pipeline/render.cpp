#include "pipeline/render.h"

#include <algorithm>
#include <chrono>
#include <numeric>
#include <stdexcept>
#include <string>

#include "base/parallel_for.h"

namespace v3dg {

static double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Gaussians a chunk: enough to spread over threads, few enough that a chunk's counters stay small.
static uint64_t chunk_size(uint64_t total, size_t num_tiles) {
    const uint64_t least = std::max<uint64_t>(4096, num_tiles);
    return std::max<uint64_t>(least, (total + 1023) / 1024);
}

// Most crowded tiles first, so that no thread is left with one of them at the end.
static std::vector<uint32_t> tiles_by_load(const uint64_t* offset, size_t num_tiles) {
    std::vector<uint32_t> order(num_tiles);
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) {
        return offset[a + 1] - offset[a] > offset[b + 1] - offset[b];
    });
    return order;
}

template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Pinhole<T>& camera, const Picture<T>& picture,
                    bool keep_source, Workspace<T>& ws) {
    const double start = now();
    std::vector<uint64_t> begin(draws.size() + 1, 0);
    for (size_t d = 0; d < draws.size(); ++d) begin[d + 1] = begin[d] + draws[d].count;
    const uint64_t total = begin.back();
    if (total > UINT32_MAX)
        throw std::length_error("gaussians: expected at most 4294967295 in one picture, got " +
                                std::to_string(total));
    const TileGrid grid(picture.width, picture.height);
    const uint64_t chunk = chunk_size(total, grid.size());
    const size_t num_chunks = (total + chunk - 1) / chunk;
    ws.num_chunks = num_chunks;

    // Room for the worst case; pages that no record reaches are never touched.
    Record<T>* records = ws.records.reserve(total);
    uint32_t* source = keep_source ? ws.source.reserve(total) : nullptr;
    uint64_t* chunk_first = ws.chunk_first.reserve(num_chunks);
    uint32_t* chunk_count = ws.chunk_count.reserve(num_chunks);
    uint64_t* chunk_in_frustum = ws.chunk_in_frustum.reserve(num_chunks);
    parallel_for(num_chunks, 1, [&](size_t c) {
        const uint64_t first = c * chunk, last = std::min(total, first + chunk);
        size_t d = std::upper_bound(begin.begin(), begin.end(), first) - begin.begin() - 1;
        size_t count = 0;
        uint64_t in_frustum = 0;
        for (uint64_t at = first; at < last; ++d) {
            const uint64_t stop = std::min(last, begin[d + 1]);
            if (stop > at)
                count += V3DG_DISPATCH_ISA(project<T>, draws[d], at - begin[d], stop - at, camera,
                                           records + first + count,
                                           source == nullptr ? nullptr : source + first + count,
                                           static_cast<uint32_t>(at - begin[d]), in_frustum);
            at = stop;
        }
        chunk_first[c] = first;
        chunk_count[c] = static_cast<uint32_t>(count);
        chunk_in_frustum[c] = in_frustum;
    });
    const double projected = now();
    tile_bin(records, RecordChunks{chunk_first, chunk_count, num_chunks}, grid, ws.lists);
    const double binned = now();

    const uint64_t* offset = ws.lists.offset.data();
    const std::vector<uint32_t> order = tiles_by_load(offset, grid.size());
#pragma omp parallel
    {
        Buffer<uint64_t> scratch;
#pragma omp for schedule(dynamic, 1)
        for (size_t i = 0; i < order.size(); ++i) {
            const uint32_t t = order[i];
            uint64_t* entry = ws.lists.entry.data() + offset[t];
            const size_t count = offset[t + 1] - offset[t];
            sort_tile(records, entry, count, scratch.reserve(count));
            V3DG_DISPATCH_ISA(rasterize_tile<T>, records, entry, count, kTileSize * (t % grid.columns),
                              kTileSize * (t / grid.columns), picture);
        }
    }
    RenderCounts counts{};
    for (size_t c = 0; c < num_chunks; ++c) {
        counts.in_frustum += chunk_in_frustum[c];
        counts.records += chunk_count[c];
    }
    counts.entries = ws.lists.num_entries;
    counts.project_seconds = projected - start;
    counts.bin_seconds = binned - projected;
    counts.rasterize_seconds = now() - binned;
    return counts;
}

template <class T>
static uint64_t num_tiles_of(const Record<T>& r) {
    return static_cast<uint64_t>(r.x1 / kTileSize - r.x0 / kTileSize + 1) *
           (r.y1 / kTileSize - r.y0 / kTileSize + 1);
}

template <class T>
void render_backward(const Draw<T>& draw, const Pinhole<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& ws,
                     const GaussianGradients<T>& out, T d_background[3]) {
    const TileGrid grid(picture.width, picture.height);
    const Record<T>* records = ws.records.data();
    const uint64_t* offset = ws.lists.offset.data();
    const uint64_t* entry = ws.lists.entry.data();
    // Each (record, tile) pair has a place of its own, the pairs of a record side by side in the order of the
    // tiles, so the sum over tiles does not depend on which thread came first.
    std::vector<uint64_t> pair_first(ws.records.capacity());
    uint64_t num_pairs = 0;
    for (size_t c = 0; c < ws.num_chunks; ++c)
        for (uint64_t r = ws.chunk_first.data()[c], end = r + ws.chunk_count.data()[c]; r < end; ++r) {
            pair_first[r] = num_pairs;
            num_pairs += num_tiles_of(records[r]);
        }
    std::vector<RecordGradient<T>> d_pair(num_pairs);
    std::vector<T> d_background_of_tile(3 * grid.size(), T(0));
    const std::vector<uint32_t> order = tiles_by_load(offset, grid.size());
#pragma omp parallel
    {
        std::vector<RecordGradient<T>> d_entry;
#pragma omp for schedule(dynamic, 1)
        for (size_t i = 0; i < order.size(); ++i) {
            const uint32_t t = order[i];
            const size_t count = offset[t + 1] - offset[t];
            const int column = t % grid.columns, row = t / grid.columns;
            d_entry.assign(count, RecordGradient<T>{});
            V3DG_DISPATCH_ISA(rasterize_tile_backward<T>, records, entry + offset[t], count,
                              kTileSize * column, kTileSize * row, picture, d_picture, d_entry.data(),
                              &d_background_of_tile[3 * t]);
            for (size_t e = 0; e < count; ++e) {
                const uint32_t r = record_of(entry[offset[t] + e]);
                const int x0 = records[r].x0 / kTileSize, x1 = records[r].x1 / kTileSize,
                          y0 = records[r].y0 / kTileSize;
                d_pair[pair_first[r] + static_cast<uint64_t>(row - y0) * (x1 - x0 + 1) + (column - x0)] =
                    d_entry[e];
            }
        }
    }
    for (size_t t = 0; t < grid.size(); ++t)
        for (int c = 0; c < 3; ++c) d_background[c] += d_background_of_tile[3 * t + c];

    parallel_for(ws.num_chunks, 1, [&](size_t c) {
        const uint64_t first = ws.chunk_first.data()[c];
        const uint32_t count = ws.chunk_count.data()[c];
        std::vector<RecordGradient<T>> d_records(count);
        for (uint32_t i = 0; i < count; ++i) {
            const Record<T>& r = records[first + i];
            const uint64_t pairs = num_tiles_of(r);
            for (uint64_t p = 0; p < pairs; ++p) d_records[i] += d_pair[pair_first[first + i] + p];
        }
        V3DG_DISPATCH_ISA(project_backward<T>, draw, ws.source.data() + first, d_records.data(), count,
                          camera, out);
    });
}

#define V3DG_INSTANTIATE(T)                                                                                  \
    template RenderCounts render<T>(const std::vector<Draw<T>>&, const Pinhole<T>&, const Picture<T>&, bool, \
                                    Workspace<T>&);                                                          \
    template void render_backward<T>(const Draw<T>&, const Pinhole<T>&, const Picture<T>&,                   \
                                     const PictureGradient<T>&, const Workspace<T>&,                         \
                                     const GaussianGradients<T>&, T*);
V3DG_INSTANTIATE(float)
V3DG_INSTANTIATE(double)
#undef V3DG_INSTANTIATE

}  // namespace v3dg

// Draws pictures and computes gradients on the CPU. The gaussians are projected and
// binned in parallel pieces, and tiles are blended in parallel.

#include "draw/render.h"
#include "draw/sense.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <numeric>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "base/clock.h"
#include "base/parallel_for.h"
#include "base/stop.h"
#include "project/project.h"
#include "rasterize/rasterize.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {

// Number of gaussians of a draw that are projected together. Gaussians that are
// adjacent in memory are usually adjacent in space, so a piece of this size covers only
// a few rows of tiles.
constexpr uint64_t kPieceSize = 4096;

struct Piece {
    size_t draw;
    uint64_t skip, count;  // range in the draw
    uint64_t first;        // index of the first gaussian in the concatenation of all draws
    Reach reach;           // set when the first band is drawn
};

// A range of pieces whose records are computed by one thread.
struct Chunk {
    size_t first, last;
};

template <class T>
static std::vector<Piece> pieces_of(const std::vector<Draw<T>>& draws) {
    std::vector<Piece> pieces;
    uint64_t total = 0;
    for (size_t d = 0; d < draws.size(); ++d)
        for (uint64_t skip = 0; skip < draws[d].count; skip += kPieceSize) {
            const uint64_t count = std::min(kPieceSize, draws[d].count - skip);
            pieces.push_back({d, skip, count, total, {}});
            total += count;
        }
    return pieces;
}

// Divides the pieces into chunks. There are enough chunks for all threads. They are
// also large enough that the counters of a chunk (one per tile) are small compared to
// its records.
static std::vector<Chunk> chunks_of(const std::vector<Piece>& pieces, size_t num_tiles) {
    const uint64_t total = pieces.empty() ? 0 : pieces.back().first + pieces.back().count;
    const uint64_t size = std::min(
        std::max({kPieceSize, uint64_t(num_tiles), (total + 1023) / 1024}), kMostChunkRecords);
    std::vector<Chunk> chunks;
    for (size_t p = 0; p < pieces.size(); ++p) {
        if (chunks.empty() ||
            pieces[p].first + pieces[p].count - pieces[chunks.back().first].first > size)
            chunks.push_back({p, p});
        chunks.back().last = p + 1;
    }
    return chunks;
}

// Allocates memory for records. Each thread takes large strips and writes its chunks
// into them contiguously. Therefore there are few gaps, and unused memory is never
// touched.
class RecordRoom {
  public:
    RecordRoom(const std::vector<Piece>& pieces, const std::vector<Chunk>& chunks)
        : mine_(most_threads()) {
        uint64_t total = 0;
        for (const Chunk& c : chunks) {
            const uint64_t end = pieces[c.last - 1].first + pieces[c.last - 1].count;
            longest_ = std::max(longest_, end - pieces[c.first].first);
            total = end;
        }
        // A thread takes a new strip when the longest chunk might not fit into its
        // current strip. So gaps make up at most an eighth of the strips.
        strip_ = 8 * longest_;
        size_ = total + total / 7 + (mine_.size() + 1) * strip_;
        if (size_ > UINT32_MAX)
            throw std::length_error(
                "gaussians: expected at most about 3000000000 in one picture, got " +
                std::to_string(total));
    }
    uint64_t size() const { return size_; }
    uint64_t used() const { return used_; }
    // Returns the index of the first record of this thread's next chunk.
    uint64_t take() {
        Strip& mine = mine_[thread_index()];
        if (mine.left < longest_)
            mine = {used_.fetch_add(strip_, std::memory_order_relaxed), strip_};
        return mine.next;
    }
    void keep(uint64_t count) {
        Strip& mine = mine_[thread_index()];
        mine.next += count;
        mine.left -= count;
    }

  private:
    struct Strip {
        uint64_t next = 0, left = 0;
    };
    uint64_t longest_ = 0, strip_ = 0, size_ = 0;
    std::atomic<uint64_t> used_{0};
    std::vector<Strip> mine_;
};

// Returns the run of gaussians that is projected after piece p. It is empty if the next
// piece is not before `last`.
template <class T>
static NextRun<T> run_after(const std::vector<Draw<T>>& draws, const std::vector<Piece>& pieces,
                            size_t p, size_t last) {
    if (p + 1 >= last) return {};
    const Draw<T>& draw = draws[pieces[p + 1].draw];
    return {.model = draw.codes == nullptr ? draw.model : nullptr,
            .first = draw.first + pieces[p + 1].skip};
}

// Returns whether loops on this thread run on a single thread.
static bool runs_alone() { return most_threads() == 1 || omp_in_parallel() != 0; }

static uint64_t num_gaussians_of(const std::vector<Piece>& pieces) {
    return pieces.empty() ? 0 : pieces.back().first + pieces.back().count;
}

// Returns the tiles in descending order of the length of their lists. So no thread
// starts a long list at the end.
static std::vector<uint32_t> tiles_by_load(const uint64_t* offset, size_t num_tiles) {
    std::vector<uint32_t> order(num_tiles);
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) {
        return offset[a + 1] - offset[a] > offset[b + 1] - offset[b];
    });
    return order;
}

// The approximate number of bytes of a band's records and entries. Records are accessed
// randomly, so smaller bands use caches better; but a band must have tiles for all
// threads. The smallest size is used in two cases: with a `stop` flag, because the flag
// is checked rarely within a band, and if each thread draws a picture of its own.
constexpr double kLeastBandBytes = 96 << 20, kMostBandBytes = 768 << 20,
                 kThreadBandBytes = 48 << 20;
static double band_bytes_of(const std::atomic<bool>* stop) {
    if (stop != nullptr || is_in_parallel()) return kLeastBandBytes;
    return std::clamp(kThreadBandBytes * most_threads(), kLeastBandBytes, kMostBandBytes);
}
// Pictures with at most this many gaussians need little memory, so they are drawn in a
// single band.
constexpr uint64_t kFewGaussians = 65536;

// Divides a window into bands of tile rows with about the same number of bytes of
// records and entries. The rows and bytes of a piece are estimated from its first few
// gaussians.
template <class T>
static std::vector<Window> bands_of(const std::vector<Draw<T>>& draws,
                                    const std::vector<Piece>& pieces, const Intrinsics<T>& camera,
                                    const Window& window, const std::atomic<bool>* stop) {
    if (pieces.empty() || pieces.back().first + pieces.back().count <= kFewGaussians)
        return {window};
    constexpr uint64_t kFew = 16;
    std::vector<Reach> reach(pieces.size());
    parallel_for(pieces.size(), 64, [&](size_t p) {
        if (is_stopped(stop)) return;
        V3DG_DISPATCH_ISA(project<T>, draws[pieces[p].draw], pieces[p].skip,
                          std::min(kFew, pieces[p].count), camera, Window{}, nullptr, nullptr, 0,
                          reach[p]);
    });
    const TileGrid grid(window);
    std::vector<double> row_bytes(grid.rows, 0.0);
    double bytes = 0;
    for (size_t p = 0; p < pieces.size(); ++p) {
        const Reach& few = reach[p];
        if (few.drawn == 0) continue;
        const int first = few.top / kTileSize, last = few.bottom / kTileSize;
        const double share =
            static_cast<double>(pieces[p].count) /
            static_cast<double>(std::min(kFew, pieces[p].count) * (last - first + 1)) *
            static_cast<double>(few.drawn * sizeof(Record<T>) + few.entries * sizeof(uint64_t));
        for (int r = std::max(first - grid.first_row, 0);
             r <= std::min(last - grid.first_row, grid.rows - 1); ++r) {
            row_bytes[r] += share;
            bytes += share;
        }
    }
    const double num_bands = std::ceil(bytes / band_bytes_of(stop));
    std::vector<Window> bands{window};
    double above = 0;
    for (int r = 0; r + 1 < grid.rows; ++r) {
        above += row_bytes[r];
        const double num_above = static_cast<double>(bands.size());
        if (num_above >= num_bands || above * num_bands < bytes * num_above) continue;
        const int edge = (grid.first_row + r + 1) * kTileSize;
        bands.back().y1 = edge;
        bands.push_back({window.x0, edge, window.x1, window.y1});
    }
    return bands;
}

// Draws one band. In the first band of a picture (`is_first`), it also sets the reach
// of each piece.
template <class T>
static void render_band(const std::vector<Draw<T>>& draws, std::vector<Piece>& pieces,
                        bool is_first, const Intrinsics<T>& camera, const Picture<T>& picture,
                        bool keep_source, Workspace<T>& ws, const std::atomic<bool>* stop,
                        RenderCounts& counts) {
    const double start = now();
    const Window& window = picture.window;
    const TileGrid grid(window);
    const std::vector<Chunk> chunks = chunks_of(pieces, grid.size());
    ws.num_chunks = chunks.size();
    RecordRoom room(pieces, chunks);
    Record<T>* records = ws.records.reserve(room.size());
    uint32_t* source = ws.source.reserve(keep_source ? room.size() : 0);
    uint64_t* chunk_first = ws.chunk_first.reserve(chunks.size());
    uint32_t* chunk_count = ws.chunk_count.reserve(chunks.size());
    ws.lists.start(chunks.size(), grid);
    parallel_for(chunks.size(), 1, [&](size_t c) {
        const uint64_t first = room.take();
        size_t count = 0;
        for (size_t p = chunks[c].first; p < chunks[c].last && !is_stopped(stop); ++p) {
            Piece& piece = pieces[p];
            if (!is_first && (piece.reach.bottom < window.y0 || piece.reach.top >= window.y1))
                continue;
            Reach reach;
            count += V3DG_DISPATCH_ISA(project<T>, draws[piece.draw], piece.skip, piece.count,
                                       camera, window, records + first + count,
                                       keep_source ? source + first + count : nullptr,
                                       static_cast<uint32_t>(piece.first), reach,
                                       run_after(draws, pieces, p, chunks[c].last));
            piece.reach = reach;
        }
        if (is_stopped(stop)) return;
        chunk_first[c] = first;
        chunk_count[c] = static_cast<uint32_t>(count);
        room.keep(count);
        bin_chunk(records, first, chunk_count[c], grid, c, ws.lists);
    });
    ws.room = room.used();
    ws.most_room = std::max(ws.most_room, ws.room);
    const double projected = now();
    if (is_stopped(stop)) return;
    join_chunks(chunks.size(), grid, ws.lists, stop);
    if (is_stopped(stop)) return;
    const double binned = now();

    const uint64_t* offset = ws.lists.offset.data();
    const std::vector<uint32_t> order = tiles_by_load(offset, grid.size());
    std::vector<Buffer<uint64_t>> scratch(most_threads());
    parallel_for(order.size(), 1, [&](size_t i) {
        if (is_stopped(stop)) return;
        const uint32_t t = order[i];
        uint64_t* entry = ws.lists.entry.data() + offset[t];
        const size_t count = offset[t + 1] - offset[t];
        sort_tile(records, ws.lists.format, entry, count, scratch[thread_index()].reserve(count));
        V3DG_DISPATCH_ISA(rasterize_tile<T>, records, ws.lists.format, entry, count,
                          kTileSize * grid.column(t), kTileSize * grid.row(t), picture);
    });
    counts.entries += ws.lists.num_entries;
    counts.project_seconds += projected - start;
    counts.bin_seconds += binned - projected;
    counts.rasterize_seconds += now() - binned;
}

// Draws a picture of at most kMostChunkRecords gaussians on one thread. All records are
// then in one sequence, and entries are written directly to the lists of their tiles.
template <class T>
static void render_alone(const std::vector<Draw<T>>& draws, std::vector<Piece>& pieces,
                         const Intrinsics<T>& camera, const Picture<T>& picture, Workspace<T>& ws,
                         const std::atomic<bool>* stop, RenderCounts& counts) {
    const double start = now();
    const TileGrid grid(picture.window);
    ws.room = num_gaussians_of(pieces);
    ws.most_room = std::max(ws.most_room, ws.room);
    Record<T>* records = ws.records.reserve(ws.room);
    ws.growing.start(grid);
    uint32_t num_records = 0;
    for (size_t p = 0; p < pieces.size() && !is_stopped(stop); ++p) {
        Piece& piece = pieces[p];
        const auto count = static_cast<uint32_t>(
            V3DG_DISPATCH_ISA(project<T>, draws[piece.draw], piece.skip, piece.count, camera,
                              picture.window, records + num_records, nullptr, 0, piece.reach,
                              run_after(draws, pieces, p, pieces.size())));
        append_records(records, num_records, count, grid, ws.growing);
        num_records += count;
    }
    const double projected = now();
    for (size_t t = 0; t < grid.size() && !is_stopped(stop); ++t) {
        const GrowingLists::List& list = ws.growing.list[t];
        sort_tile(records, kChunkFormat, list.data(), list.size(), ws.scratch.reserve(list.size()));
        V3DG_DISPATCH_ISA(rasterize_tile<T>, records, kChunkFormat, list.data(), list.size(),
                          kTileSize * grid.column(t), kTileSize * grid.row(t), picture);
        counts.entries += list.size();
    }
    counts.project_seconds += projected - start;
    counts.rasterize_seconds += now() - projected;
}

// Returns the part of a picture inside a band.
template <class T>
static Picture<T> band_of(const Picture<T>& picture, const Window& band) {
    const size_t skip = static_cast<size_t>(band.y0 - picture.window.y0) *
                        static_cast<size_t>(picture.window.width());
    Picture<T> part = picture;
    part.window = band;
    part.color += picture.color_step * skip;
    if (part.alpha != nullptr) part.alpha += picture.alpha_step * skip;
    if (part.depth != nullptr) part.depth += skip;
    if (part.count != nullptr) part.count += skip;
    return part;
}

// Runs the sensor pass over a band after it was drawn.
static void sense(const std::vector<Draw<float>>& draws, const Picture<float>& picture,
                  const Window& band, const DrawnSensor& sensor, Workspace<float>& ws,
                  const std::atomic<bool>* stop) {
    const size_t skip = static_cast<size_t>(band.y0 - picture.window.y0) *
                        static_cast<size_t>(picture.window.width());
    DrawnSensor part = sensor;
    part.sensor = sensor.sensor.from(skip);
    sense_band(draws, band_of(picture, band), part, ws, stop);
}

template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Intrinsics<T>& camera,
                    const Picture<T>& picture, bool keep_source, Workspace<T>& ws,
                    const std::atomic<bool>* stop, const DrawnSensor* sensor) {
    RenderCounts counts{};
    const bool needs_source = keep_source || (sensor != nullptr && needs_source_of(*sensor));
    std::vector<Piece> pieces = pieces_of(draws);
    const std::vector<Window> bands = keep_source
                                          ? std::vector<Window>{picture.window}
                                          : bands_of(draws, pieces, camera, picture.window, stop);
    const bool is_alone = !keep_source && sensor == nullptr && bands.size() == 1 && runs_alone() &&
                          num_gaussians_of(pieces) <= kMostChunkRecords;
    if (is_alone) render_alone(draws, pieces, camera, picture, ws, stop, counts);
    for (size_t b = 0; b < bands.size() && !is_alone && !is_stopped(stop); ++b) {
        render_band(draws, pieces, b == 0, camera, band_of(picture, bands[b]), needs_source, ws,
                    stop, counts);
        if constexpr (std::is_same_v<T, float>)
            if (sensor != nullptr) sense(draws, picture, bands[b], *sensor, ws, stop);
    }
    for (const Piece& piece : pieces) {
        counts.in_frustum += piece.reach.in_frustum;
        counts.records += piece.reach.drawn;
    }
    return counts;
}

template <class T>
static uint64_t num_tiles_of(const Record<T>& r) {
    return static_cast<uint64_t>(r.x1 / kTileSize - r.x0 / kTileSize + 1) *
           (r.y1 / kTileSize - r.y0 / kTileSize + 1);
}

template <class T>
void render_backward(const Draw<T>& draw, const Intrinsics<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& ws,
                     const GaussianRows<T>& out, const CenterGradients<T>& centers,
                     T d_background[3], const ViewSums* sums) {
    const TileGrid grid(picture.window);
    const Record<T>* records = ws.records.data();
    const uint64_t* offset = ws.lists.offset.data();
    const uint64_t* entry = ws.lists.entry.data();
    // A record has one gradient slot for each of its tiles. The slots are added in the
    // order of the tiles, so that the sum does not depend on the order in which threads
    // run.
    std::vector<uint64_t> first_slot(ws.room);
    uint64_t num_slots = 0;
    for (size_t c = 0; c < ws.num_chunks; ++c)
        for (uint64_t r = ws.chunk_first.data()[c], end = r + ws.chunk_count.data()[c]; r < end;
             ++r) {
            first_slot[r] = num_slots;
            num_slots += num_tiles_of(records[r]);
        }
    std::vector<RecordGradient<T>> d_slot(num_slots);
    const bool with_size = centers.size != nullptr;
    std::vector<CenterSize<T>> size_of_slot(with_size ? num_slots : 0);
    std::vector<T> d_background_of_tile(3 * grid.size(), T(0));
    const std::vector<uint32_t> order = tiles_by_load(offset, grid.size());
    std::vector<std::vector<RecordGradient<T>>> d_entries(most_threads());
    std::vector<std::vector<CenterSize<T>>> sizes(most_threads());
    parallel_for(order.size(), 1, [&](size_t i) {
        const uint32_t t = order[i];
        const size_t count = offset[t + 1] - offset[t];
        const int column = grid.column(t), row = grid.row(t);
        std::vector<RecordGradient<T>>& d_entry = d_entries[thread_index()];
        d_entry.assign(count, RecordGradient<T>{});
        std::vector<CenterSize<T>>& size = sizes[thread_index()];
        size.assign(with_size ? count : 0, CenterSize<T>{});
        V3DG_DISPATCH_ISA(rasterize_tile_backward<T>, records, ws.lists.format, entry + offset[t],
                          count, kTileSize * column, kTileSize * row, picture, d_picture,
                          d_entry.data(), with_size ? size.data() : nullptr,
                          &d_background_of_tile[3 * t]);
        for (size_t e = 0; e < count; ++e) {
            const uint64_t r = ws.lists.format.record_of(entry[offset[t] + e]);
            const int x0 = records[r].x0 / kTileSize, x1 = records[r].x1 / kTileSize,
                      y0 = records[r].y0 / kTileSize;
            const uint64_t slot =
                first_slot[r] + static_cast<uint64_t>(row - y0) * (x1 - x0 + 1) + (column - x0);
            d_slot[slot] = d_entry[e];
            if (with_size) size_of_slot[slot] = size[e];
        }
    });
    for (size_t t = 0; t < grid.size(); ++t)
        for (int c = 0; c < 3; ++c) d_background[c] += d_background_of_tile[3 * t + c];

    const bool with_pose = sums != nullptr && sums->pose != nullptr;
    std::vector<PoseSums<double>> pose_of_chunk(with_pose ? ws.num_chunks : 0);
    parallel_for(ws.num_chunks, 1, [&](size_t c) {
        const uint64_t first = ws.chunk_first.data()[c];
        const uint32_t count = ws.chunk_count.data()[c];
        std::vector<RecordGradient<T>> d_records(count);
        for (uint32_t i = 0; i < count; ++i) {
            const Record<T>& r = records[first + i];
            const uint64_t begin = first_slot[first + i], end = begin + num_tiles_of(r);
            for (uint64_t p = begin; p < end; ++p) d_records[i] += d_slot[p];
            const uint32_t gaussian = ws.source.data()[first + i];
            if (with_size) {
                CenterSize<T> size{};
                for (uint64_t p = begin; p < end; ++p) size += size_of_slot[p];
                centers.size[gaussian] = size;
            }
            if (centers.sum != nullptr) {
                centers.sum[2 * static_cast<size_t>(gaussian)] = d_records[i].ellipse.u;
                centers.sum[2 * static_cast<size_t>(gaussian) + 1] = d_records[i].ellipse.v;
            }
        }
        if (sums == nullptr)
            V3DG_DISPATCH_ISA(project_backward<T>, draw, ws.source.data() + first, d_records.data(),
                              count, camera, out);
        else
            V3DG_DISPATCH_ISA(add_project_backward<T>, draw, ws.source.data() + first,
                              d_records.data(), count, camera, out,
                              with_pose ? &pose_of_chunk[c] : nullptr);
    });
    for (const PoseSums<double>& part : pose_of_chunk) add(part, *sums->pose);
}

bool pick(const std::vector<Draw<float>>& draws, const Intrinsics<float>& camera, int x, int y,
          Pick& picked) {
    float color[3], alpha;
    const Picture<float> pixel{{x, y, x + 1, y + 1}, {0, 0, 0}, color, &alpha, nullptr};
    Workspace<float> ws;
    render<float>(draws, camera, pixel, true, ws);
    picked.weight = 0.0f;
    float transmittance = 1.0f;
    for (uint64_t e = ws.lists.offset.data()[0]; e < ws.lists.offset.data()[1]; ++e) {
        const uint64_t place = ws.lists.format.record_of(ws.lists.entry.data()[e]);
        const Record<float>& r = ws.records.data()[place];
        const Falloff<float> f =
            falloff_at(static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f, r.u, r.v, r.l11,
                       r.l12, r.l22, r.log2_opacity);
        const bool goes_on = blend_live(f, transmittance, StopsBefore{}, [&](float weight) {
            if (weight > picked.weight) picked = {ws.source.data()[place], weight, r.depth};
        });
        if (!goes_on) break;
    }
    return picked.weight > 0.0f;
}

#define V3DG_INSTANTIATE(T)                                                                   \
    template RenderCounts render<T>(const std::vector<Draw<T>>&, const Intrinsics<T>&,        \
                                    const Picture<T>&, bool, Workspace<T>&,                   \
                                    const std::atomic<bool>*, const DrawnSensor*);            \
    template void render_backward<T>(const Draw<T>&, const Intrinsics<T>&, const Picture<T>&, \
                                     const PictureGradient<T>&, const Workspace<T>&,          \
                                     const GaussianRows<T>&, const CenterGradients<T>&, T*,   \
                                     const ViewSums*);
V3DG_INSTANTIATE(float)
V3DG_INSTANTIATE(double)
#undef V3DG_INSTANTIATE

}  // namespace v3dg

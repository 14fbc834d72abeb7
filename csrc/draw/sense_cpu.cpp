// The sensor pass of a frame on the CPU. It finds the normal and the instance of each
// record, processes the tiles in parallel, and marks pixels that the near plane clips.

#include "draw/sense.h"

#include <algorithm>

#include "base/parallel_for.h"
#include "base/stop.h"
#include "quantize/quantize_math.h"
#include "rasterize/clipped_math.h"
#include "rasterize/sense.h"
#include "rasterize/sense_math.h"

namespace v3dg {

namespace {

// Returns a gaussian of a draw, without its colour.
Gaussian3d<float> gaussian_of(const Draw<float>& draw, uint64_t index) {
    const uint64_t row = draw.first + index;
    Gaussian3d<float> g;
    if (draw.codes != nullptr) {
        const Codes& codes = *draw.codes;
        const auto end =
            std::upper_bound(codes.offset.begin(), codes.offset.end(), static_cast<int64_t>(row));
        const auto cluster = static_cast<uint32_t>(end - codes.offset.begin() - 1);
        const ClusterRanges& ranges = codes.ranges_of(cluster);
        float color[3];
        decode(codes.record_of(ranges, static_cast<uint32_t>(row)), ranges, g, color);
        return g;
    }
    const GaussianPlanes<float>& m = *draw.model;
    for (int k = 0; k < 3; ++k) g.mean[k] = m.mean[k][row];
    for (int k = 0; k < 4; ++k) g.quat[k] = m.quat[k][row];
    for (int k = 0; k < 3; ++k) g.scale[k] = m.scale[k][row];
    g.opacity = m.opacity[row];
    return g;
}

// Returns the end of each draw's gaussians in the concatenation of all draws.
std::vector<uint64_t> ends_of(const std::vector<Draw<float>>& draws) {
    std::vector<uint64_t> ends;
    uint64_t end = 0;
    for (const Draw<float>& draw : draws) ends.push_back(end += draw.count);
    return ends;
}

// Calls visit(record, draw, index in the draw) for the records of chunk c.
template <class Visit>
void for_each_source(const Workspace<float>& ws, const std::vector<Draw<float>>& draws,
                     const std::vector<uint64_t>& end_of_draw, size_t c, const Visit& visit) {
    const uint64_t first = ws.chunk_first.data()[c], end = first + ws.chunk_count.data()[c];
    if (first == end) return;
    size_t d = static_cast<size_t>(
        std::upper_bound(end_of_draw.begin(), end_of_draw.end(), ws.source.data()[first]) -
        end_of_draw.begin());
    for (uint64_t r = first; r < end; ++r) {
        const uint64_t gaussian = ws.source.data()[r];  // ascending within a chunk
        while (end_of_draw[d] <= gaussian) ++d;
        visit(r, d, gaussian + draws[d].count - end_of_draw[d]);
    }
}

void set_normal(const Draw<float>& draw, uint64_t index, float normal[3]) {
    const Gaussian3d<float> g = gaussian_of(draw, index);
    float p[3];
    to_view(draw.view, g.mean, p);
    normal_of_gaussian(g.quat, g.scale, draw.view, p, normal);
}

// Computes the data of each record that the channels need.
SensedRecords sensed_records(const std::vector<Draw<float>>& draws, const DrawnSensor& sensor,
                             Workspace<float>& ws) {
    const SensorPlanes& planes = sensor.sensor.planes;
    SensedRecords sensed{nullptr, nullptr, nullptr};
    if (!needs_source_of(sensor)) return sensed;
    const std::vector<uint64_t> end_of_draw = ends_of(draws);
    float* normals = planes.normal == nullptr ? nullptr : ws.normals.reserve(3 * ws.room);
    int32_t* instances = planes.wants_ids() ? ws.instances.reserve(ws.room) : nullptr;
    parallel_for(ws.num_chunks, 1, [&](size_t c) {
        for_each_source(ws, draws, end_of_draw, c, [&](uint64_t r, size_t d, uint64_t index) {
            if (normals != nullptr) set_normal(draws[d], index, normals + 3 * r);
            if (instances != nullptr) instances[r] = sensor.instance_of_draw[d];
        });
    });
    sensed.normal = normals;
    sensed.instance = instances;
    if (!sensor.label_of_instance.empty()) sensed.label = sensor.label_of_instance.data;
    return sensed;
}

// Appends the clipped bodies among some gaussians of a draw.
void add_bodies(const Draw<float>& draw, uint64_t first, uint64_t last, double near_depth,
                std::vector<ClippedBody>& bodies) {
    for (uint64_t i = first; i < last; ++i) {
        const Gaussian3d<float> g = gaussian_of(draw, i);
        float p[3];
        to_view(draw.view, g.mean, p);
        if (!(p[2] < static_cast<float>(near_depth))) continue;
        const double mean[3] = {p[0], p[1], p[2]};
        double axes[9];
        axes_in_view(g, draw.view, axes);
        ClippedBody body;
        const double opacity = double(g.opacity) * draw.weight;
        if (set_clipped_body(mean, axes, opacity, near_depth, body)) bodies.push_back(body);
    }
}

// Returns the clipped bodies of all draws.
std::vector<ClippedBody> bodies_of(const std::vector<Draw<float>>& draws, double near_depth,
                                   const std::atomic<bool>* stop) {
    constexpr uint64_t kTogether = 4096;
    std::vector<std::pair<size_t, uint64_t>> parts;  // each element: draw, index of the
                                                     // first gaussian
    for (size_t d = 0; d < draws.size(); ++d)
        for (uint64_t first = 0; first < draws[d].count; first += kTogether)
            parts.emplace_back(d, first);
    std::vector<std::vector<ClippedBody>> found(parts.size());
    parallel_for(parts.size(), 1, [&](size_t k) {
        if (is_stopped(stop)) return;
        const Draw<float>& draw = draws[parts[k].first];
        const uint64_t first = parts[k].second;
        add_bodies(draw, first, std::min(first + kTogether, draw.count), near_depth, found[k]);
    });
    std::vector<ClippedBody> bodies;
    for (const std::vector<ClippedBody>& part : found)
        bodies.insert(bodies.end(), part.begin(), part.end());
    return bodies;
}

}  // namespace

bool needs_source_of(const DrawnSensor& sensor) {
    return sensor.sensor.planes.normal != nullptr || sensor.sensor.planes.wants_ids();
}

void sense_band(const std::vector<Draw<float>>& draws, const Picture<float>& picture,
                const DrawnSensor& sensor, Workspace<float>& ws, const std::atomic<bool>* stop) {
    if (is_stopped(stop)) return;
    if (!sensor.sensor.planes.wants_walk() && !sensor.sensor.mesh.is_there()) return;
    const TileGrid grid(picture.window);
    const SensedRecords sensed = sensed_records(draws, sensor, ws);
    const uint64_t* offset = ws.lists.offset.data();
    parallel_for(grid.size(), 1, [&](size_t t) {
        if (is_stopped(stop)) return;
        V3DG_DISPATCH_ISA(sense_tile, ws.records.data(), sensed, ws.lists.format,
                          ws.lists.entry.data() + offset[t], offset[t + 1] - offset[t],
                          kTileSize * grid.column(t), kTileSize * grid.row(t), picture,
                          sensor.sensor);
    });
}

void mark_clipped(const std::vector<Draw<float>>& draws, const PixelSlopes& slopes,
                  const Window& window, uint8_t* clipped, const std::atomic<bool>* stop) {
    const double near_depth = slopes.near_depth();
    const std::vector<ClippedBody> bodies = bodies_of(draws, near_depth, stop);
    const auto width = static_cast<size_t>(window.width());
    parallel_for(static_cast<size_t>(window.height()), 1, [&](size_t row) {
        if (is_stopped(stop)) return;
        const double y = slopes.y_of(window.y0 + static_cast<double>(row));
        for (size_t column = 0; column < width; ++column) {
            const double x = slopes.x_of(window.x0 + static_cast<double>(column));
            clipped[row * width + column] = std::any_of(
                bodies.begin(), bodies.end(),
                [&](const ClippedBody& body) { return meets_body(body, x, y, near_depth); });
        }
    });
}

}  // namespace v3dg

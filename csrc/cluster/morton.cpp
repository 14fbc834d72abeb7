#include "cluster/morton.h"

#include <algorithm>
#include <limits>
#include <utility>
#include <vector>

#include "base/parallel_for.h"

namespace v3dg {

constexpr size_t kChunk = 4096;  // number of points that a thread processes together
constexpr int kBits = 21;        // bits per coordinate, so that three coordinates fit
                                 // into 64 bits

void morton_order(Span<const Point> points, Span<int64_t> order) {
    Point low = points.empty() ? Point{} : points[0], high = low;
    for (const Point& point : points)
        for (int a = 0; a < 3; ++a) {
            low.axis[a] = std::min(low.axis[a], point.axis[a]);
            high.axis[a] = std::max(high.axis[a], point.axis[a]);
        }
    // The keys are pairs of code and index, so that equal codes are ordered by index.
    std::vector<std::pair<uint64_t, int64_t>> keys(points.size);
    parallel_for(points.size, kChunk, [&](size_t i) {
        uint64_t code = 0;
        for (int a = 0; a < 3; ++a) {
            const double least = std::numeric_limits<float>::min();
            const double extent = std::max(double{high.axis[a]} - low.axis[a], least);
            const double share = (double{points[i].axis[a]} - low.axis[a]) / extent;
            const auto cell = static_cast<uint64_t>(share * ((1 << kBits) - 1));
            for (int bit = 0; bit < kBits; ++bit) code |= (cell >> bit & 1) << (3 * bit + a);
        }
        keys[i] = {code, static_cast<int64_t>(i)};
    });
    std::sort(keys.begin(), keys.end());
    for (size_t i = 0; i < order.size; ++i) order[i] = keys[i].second;
}

}  // namespace v3dg

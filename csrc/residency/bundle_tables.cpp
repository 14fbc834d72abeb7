#include "residency/bundle_tables.h"

#include <algorithm>
#include <vector>

#include "base/parallel_for.h"
#include "residency/upload.h"

namespace v3dg {
namespace cuda {

std::vector<uint8_t> joins_of_clusters(const ClusterTable& table,
                                       const ClusterAppearance& appearance) {
    std::vector<uint8_t> joins((table.num_clusters() + kClustersOfBounds - 1) / kClustersOfBounds,
                               0);
    parallel_for(joins.size(), 512, [&](size_t i) {
        const size_t first = i * kClustersOfBounds;
        const size_t count = std::min(kClustersOfBounds, table.num_clusters() - first);
        for (size_t k = 1; k < count; ++k) {
            const size_t before = first + k - 1, c = first + k;
            if (table.follows(c) && appearance[before] == appearance[c] &&
                appearance.faded(table, before) == appearance.faded(table, c))
                joins[i] |= 1 << k;
        }
    });
    return joins;
}

BundleTables::BundleTables(const ClusterTable& table, const ClusterAppearance& appearance,
                           cudaStream_t stream)
    : on_device_{.table = table,
                 .appearance = appearance,
                 .bounds = {},
                 .joins = nullptr,
                 .runs = runs_of_clusters(table)} {
    static_assert(kClustersOfBounds <= 8, "a byte of `joins` has one bit per cluster");
    const std::vector<ClusterBounds> bounds = bounds_of_clusters(table);
    const std::vector<uint8_t> joins = joins_of_clusters(table, appearance);
    on_device_.bounds = {bounds.data(), bounds.size()};
    Span<const uint8_t> joins_on_device{joins.data(), joins.size()};
    Upload upload;
    upload.add(on_device_.table);
    upload.add(on_device_.appearance.filter_px2);
    upload.add(on_device_.appearance.antialiased);
    upload.add(on_device_.bounds);
    upload.add(joins_on_device);
    upload.finish(storage_, stream);
    on_device_.joins = joins_on_device.data;
}

}  // namespace cuda
}  // namespace v3dg

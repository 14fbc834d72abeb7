#include "residency/bundle_tables.h"

#include <algorithm>
#include <functional>
#include <vector>

#include "base/parallel_for.h"

namespace v3dg {
namespace cuda {

namespace {

// Copies arrays of the host into one allocation on the device.
class Upload {
  public:
    // `span` points to memory of the host; finish() makes it point to memory of the
    // device.
    template <class T>
    void add(Span<const T>& span) {
        const size_t first = (num_bytes_ + kAlignment - 1) / kAlignment * kAlignment;
        num_bytes_ = first + span.size * sizeof(T);
        moves_.push_back([&span, first](unsigned char* start, cudaStream_t stream) {
            if (span.size > 0)
                check(cudaMemcpyAsync(start + first, span.data, span.size * sizeof(T),
                                      cudaMemcpyHostToDevice, stream),
                      "cudaMemcpyAsync");
            span.data = reinterpret_cast<const T*>(start + first);
        });
    }
    void finish(DeviceBuffer<unsigned char>& storage, cudaStream_t stream) {
        storage.reserve(num_bytes_, stream);
        for (const auto& move : moves_) move(storage.data(), stream);
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
    }

  private:
    static constexpr size_t kAlignment = 256;  // equal to the alignment of the device's allocator

    size_t num_bytes_ = 0;
    std::vector<std::function<void(unsigned char*, cudaStream_t)>> moves_;
};

}  // namespace

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
    static_assert(kClustersOfBounds <= 8, "a byte has a bit for each of them");
    const std::vector<ClusterBounds> bounds = bounds_of_clusters(table);
    const std::vector<uint8_t> joins = joins_of_clusters(table, appearance);
    on_device_.bounds = {bounds.data(), bounds.size()};
    Span<const uint8_t> joins_on_device{joins.data(), joins.size()};
    ClusterTable& t = on_device_.table;
    Upload upload;
    upload.add(t.ball);
    upload.add(t.weight);
    upload.add(t.level);
    upload.add(t.own_group);
    upload.add(t.parent_group);
    upload.add(t.box);
    upload.add(t.offset);
    upload.add(t.top_group);
    upload.add(t.top_cluster);
    upload.add(t.pages.shift);
    upload.add(t.pages.begins);
    upload.add(on_device_.appearance.filter_px2);
    upload.add(on_device_.appearance.antialiased);
    upload.add(on_device_.bounds);
    upload.add(joins_on_device);
    upload.finish(storage_, stream);
    on_device_.joins = joins_on_device.data;
}

}  // namespace cuda
}  // namespace v3dg

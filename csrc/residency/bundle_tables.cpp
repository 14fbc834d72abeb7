#include "residency/bundle_tables.h"

#include <cstring>
#include <functional>
#include <vector>

namespace v3dg {
namespace cuda {

namespace {

// Collects arrays of the host, which then go to the device as one piece of memory.
class Upload {
  public:
    // `span` is the host's until finish() makes it the device's.
    template <class T>
    void add(Span<const T>& span) {
        const size_t first = (bytes_.size() + kAlignment - 1) / kAlignment * kAlignment;
        bytes_.resize(first + span.size * sizeof(T));
        if (span.size > 0) std::memcpy(bytes_.data() + first, span.data, span.size * sizeof(T));
        moves_.push_back([&span, first](const unsigned char* start) {
            span.data = reinterpret_cast<const T*>(start + first);
        });
    }
    void finish(DeviceBuffer<unsigned char>& storage, cudaStream_t stream) {
        storage.copy_from({bytes_.data(), bytes_.size()}, stream);
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
        for (const auto& move : moves_) move(storage.data());
    }

  private:
    static constexpr size_t kAlignment = 256;  // as of memory from the device's allocator

    std::vector<unsigned char> bytes_;
    std::vector<std::function<void(const unsigned char*)>> moves_;
};

}  // namespace

std::vector<uint8_t> joins_of_clusters(const ClusterTable& table, const ClusterAppearance& appearance) {
    std::vector<uint8_t> joins((table.num_clusters() + kClustersOfBounds - 1) / kClustersOfBounds, 0);
    for (size_t c = 0; c < table.num_clusters(); ++c) {
        const size_t k = c % kClustersOfBounds;
        if (k > 0 && table.follows(c) && appearance[c - 1] == appearance[c])
            joins[c / kClustersOfBounds] |= 1 << k;
    }
    return joins;
}

BundleTables::BundleTables(const ClusterTable& table, const ClusterAppearance& appearance,
                           cudaStream_t stream)
    : on_device_{table, appearance, {}, nullptr} {
    static_assert(kClustersOfBounds <= 8, "a byte says which of them are drawn together");
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
    upload.add(on_device_.appearance.filter_px2);
    upload.add(on_device_.appearance.antialiased);
    upload.add(on_device_.bounds);
    upload.add(joins_on_device);
    upload.finish(storage_, stream);
    on_device_.joins = joins_on_device.data;
}

}  // namespace cuda
}  // namespace v3dg

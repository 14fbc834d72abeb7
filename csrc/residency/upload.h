#pragma once

// Copies the tables of bundles to a device.

#include <functional>
#include <vector>

#include "base/device.h"
#include "residency/cluster_table.h"

namespace v3dg {
namespace cuda {

// Copies host arrays to one allocation on the device.
class Upload {
  public:
    // Adds an array. finish() will set `span` to the copy on the device.
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
    // Adds all arrays of a table.
    void add(ClusterTable& table) {
        add(table.ball);
        add(table.weight);
        add(table.level);
        add(table.own_group);
        add(table.parent_group);
        add(table.box);
        add(table.offset);
        add(table.top_group);
        add(table.top_cluster);
        add(table.pages.shift);
        add(table.pages.begins);
    }
    // Allocates device memory, and copies the arrays to it before it returns.
    void finish(DeviceBuffer<unsigned char>& storage, cudaStream_t stream) {
        storage.reserve(num_bytes_, stream);
        for (const auto& move : moves_) move(storage.data(), stream);
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
    }

  private:
    static constexpr size_t kAlignment = 256;  // the alignment of CUDA's allocator

    size_t num_bytes_ = 0;
    std::vector<std::function<void(unsigned char*, cudaStream_t)>> moves_;
};

}  // namespace cuda
}  // namespace v3dg

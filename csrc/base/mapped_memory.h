#pragma once

// Device memory that grows without moving, for buffers whose size changes when the
// camera moves.
//
// To grow a buffer of a pool, it must be freed and a larger one allocated, which takes
// as long as drawing several frames. A buffer of this file reserves as many addresses
// as the device has memory. When it grows, more memory is mapped after the part that is
// in use.

#include <vector>

#include "base/device.h"

namespace v3dg {
namespace cuda {

// A range of addresses. The first bytes() of it are mapped to memory of the device that
// was current in the first call of reserve().
class MappedMemory {
  public:
    MappedMemory() = default;
    MappedMemory(MappedMemory&& other) noexcept { swap(other); }
    MappedMemory& operator=(MappedMemory&& other) noexcept {
        swap(other);
        return *this;
    }
    // Precondition: the device has finished the work that uses the memory.
    ~MappedMemory();

    // Returns whether the current device can map memory.
    static bool is_supported();

    // Makes room for `bytes`. The address stays the same, so work in progress is not
    // affected. `stream` must belong to the device. Throws OutOfMemory; memory that was
    // reserved earlier then stays reserved.
    void* reserve(size_t bytes, cudaStream_t stream);
    void* data() const { return reinterpret_cast<void*>(first_); }
    size_t bytes() const { return num_bytes_; }

  private:
    void swap(MappedMemory& other) noexcept;

    unsigned long long first_ = 0;  // address of the range
    size_t range_bytes_ = 0;
    size_t num_bytes_ = 0;
    std::vector<size_t> piece_bytes_;  // sizes of the pieces of memory that were mapped
                                       // together
    int device_ = 0;
};

// Like DeviceBuffer, but reserve() does not move an array that is `in_place`. An array
// that is not in place is a DeviceBuffer. This is always the case on devices that
// cannot map memory.
template <class T>
class GrowingBuffer {
  public:
    explicit GrowingBuffer(bool in_place = false) : in_place_(in_place) {}

    bool is_in_place() const { return in_place_; }
    T* reserve(size_t size, cudaStream_t stream) {
        if (!in_place_) return moving_.reserve(size, stream);
        if (size * sizeof(T) > mapped_.bytes()) refuse_capture(stream);
        return static_cast<T*>(mapped_.reserve(size * sizeof(T), stream));
    }
    // Frees the memory. Precondition for an array in place: the device has finished the
    // work that uses it.
    void release() {
        const MappedMemory mapped = std::move(mapped_);
        const DeviceBuffer<T> moving = std::move(moving_);
    }
    T* data() const { return in_place_ ? static_cast<T*>(mapped_.data()) : moving_.data(); }
    size_t capacity() const { return bytes() / sizeof(T); }
    size_t bytes() const { return in_place_ ? mapped_.bytes() : moving_.bytes(); }

  private:
    bool in_place_;
    DeviceBuffer<T> moving_;
    MappedMemory mapped_;
};

}  // namespace cuda
}  // namespace v3dg

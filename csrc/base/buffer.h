#pragma once

// Host memory that may lose its contents when it grows. DeviceBuffer (device.h) is the
// counterpart on devices.

#include <cstddef>
#include <new>
#include <utility>

#include "base/host_memory.h"
#include "base/span.h"

namespace v3dg {

// An uninitialised array of a plain type. When it grows, its contents are lost.
template <class T>
class Buffer {
  public:
    Buffer() = default;
    explicit Buffer(size_t size) { reserve(size); }
    Buffer(Buffer&& other) noexcept
        : data_(std::exchange(other.data_, nullptr)),
          capacity_(std::exchange(other.capacity_, 0)) {}
    Buffer& operator=(Buffer&& other) noexcept {
        std::swap(data_, other.data_);
        std::swap(capacity_, other.capacity_);
        return *this;
    }
    ~Buffer() { free_pages(data_); }

    // Makes room for `size` elements. Throws std::bad_alloc.
    T* reserve(size_t size) {
        if (size > capacity_) {
            free_pages(data_);
            data_ = nullptr;
            capacity_ = 0;
            data_ = static_cast<T*>(allocate_pages(size * sizeof(T)));
            if (data_ == nullptr) throw std::bad_alloc();
            capacity_ = size;
        }
        return data_;
    }
    T* data() const { return data_; }
    size_t capacity() const { return capacity_; }

  private:
    T* data_ = nullptr;
    size_t capacity_ = 0;
};

}  // namespace v3dg

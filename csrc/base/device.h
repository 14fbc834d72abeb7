#pragma once

// Memory and errors of the CUDA half. A DeviceBuffer frees itself into a pool of its device,
// trim_pool() gives what the pool keeps to the driver. v3dg/residency.py says when what stays on a
// device is freed. Sources that include it are built only with CUDA.

#include <cuda_runtime.h>

#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>

#include "base/span.h"

namespace v3dg {
namespace cuda {

// The device has no room; what() names what was asked for and what was free. Python gets a
// MemoryError, as of every std::bad_alloc.
class OutOfMemory : public std::bad_alloc {
  public:
    explicit OutOfMemory(std::string text) : text_(std::move(text)) {}
    const char* what() const noexcept override { return text_.c_str(); }

  private:
    std::string text_;
};

// Throws std::runtime_error with CUDA's own words unless the call succeeded; `what` names it.
void check(cudaError_t error, const char* what);

// How many devices there are; 0 without a driver.
int num_devices();
int current_device();
// How many multiprocessors the current device has.
unsigned num_multiprocessors();

// Bytes of shared memory that one of them has.
size_t shared_memory_of_multiprocessor();

// Lets the kernel have `bytes` of dynamic shared memory on the current device, which has to be
// asked for where it is more than 48 KiB with what the kernel declares. The driver's limit is one
// for all threads, so it is only ever raised: a lower one could come between another thread's
// asking and its launch. `name` goes into errors.
void allow_shared_memory(const void* kernel, size_t bytes, const char* name);

// Whether what the current device runs of the kernel is code that waits for the kernel before it.
bool can_start_early(const void* kernel);

// Stream-ordered memory of the current device, from a pool that keeps what is given back for the
// next caller. Throws OutOfMemory.
void* allocate(size_t bytes, cudaStream_t stream);
// Of memory and a stream of `device`, whichever is current.
void release(void* pointer, int device, cudaStream_t stream) noexcept;
// Waits for the stream, and returns to the driver what the pool keeps.
void trim_pool(cudaStream_t stream);

// What the pool of the current device has of the driver, and how much of that is in use.
struct PoolBytes {
    size_t reserved, used;
};
PoolBytes pool_bytes();

bool is_capturing(cudaStream_t stream);
// Throws std::runtime_error while it is: memory from a graph is gone with the graph.
void refuse_capture(cudaStream_t stream);

// Guards memory that several threads and streams use, one after the other.
class StreamMutex {
  public:
    StreamMutex();
    ~StreamMutex();
    // Waits until the device is done with what was enqueued under the last lock, and so with all
    // before it.
    void wait() const noexcept;
    StreamMutex(const StreamMutex&) = delete;
    StreamMutex& operator=(const StreamMutex&) = delete;

  private:
    friend class StreamLock;
    std::mutex busy_;
    cudaEvent_t done_ = nullptr;
    cudaStream_t last_ = nullptr;
};

// While it lives, the memory belongs to one thread, and what that enqueues on the stream runs after
// what was enqueued under the lock before. It does not order what a graph captures: whoever replays
// the graph does that.
class StreamLock {
  public:
    StreamLock(StreamMutex& mutex, cudaStream_t stream);
    ~StreamLock();
    StreamLock(const StreamLock&) = delete;
    StreamLock& operator=(const StreamLock&) = delete;

  private:
    const std::lock_guard<std::mutex> lock_;
    StreamMutex& mutex_;
    cudaStream_t stream_;
    bool is_captured_;
};

// Owned elements of a plain type, not initialised, on the device that is current when it grows.
// Grows by forgetting what it held. Whoever uses it on several streams orders them.
template <class T>
class DeviceBuffer {
  public:
    DeviceBuffer() = default;
    DeviceBuffer(size_t size, cudaStream_t stream) { reserve(size, stream); }
    DeviceBuffer(Span<const T> host, cudaStream_t stream) { copy_from(host, stream); }
    DeviceBuffer(DeviceBuffer&& other) noexcept { swap(other); }
    DeviceBuffer& operator=(DeviceBuffer&& other) noexcept {
        swap(other);
        return *this;
    }
    ~DeviceBuffer() { release(data_, device_, stream_); }

    // Room for `size` elements, allocated and given back in the order of `stream`.
    T* reserve(size_t size, cudaStream_t stream) {
        if (size > capacity_) {
            refuse_capture(stream);
            release(data_, device_, stream_);
            data_ = nullptr;
            capacity_ = 0;
            device_ = current_device();
            data_ = static_cast<T*>(allocate(size * sizeof(T), stream));
            capacity_ = size;
        }
        stream_ = stream;
        return data_;
    }
    // The host's memory may be reused on return.
    T* copy_from(Span<const T> host, cudaStream_t stream) {
        reserve(host.size, stream);
        if (host.size > 0)
            check(cudaMemcpyAsync(data_, host.data, host.size * sizeof(T), cudaMemcpyHostToDevice,
                                  stream),
                  "cudaMemcpyAsync to the device");
        return data_;
    }
    T* data() const { return data_; }
    size_t capacity() const { return capacity_; }
    size_t bytes() const { return capacity_ * sizeof(T); }

  private:
    void swap(DeviceBuffer& other) noexcept {
        std::swap(data_, other.data_);
        std::swap(capacity_, other.capacity_);
        std::swap(device_, other.device_);
        std::swap(stream_, other.stream_);
    }

    T* data_ = nullptr;
    size_t capacity_ = 0;
    int device_ = 0;
    cudaStream_t stream_ = nullptr;
};

}  // namespace cuda
}  // namespace v3dg

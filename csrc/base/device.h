#pragma once

// Device memory and error handling for CUDA. A DeviceBuffer returns its memory to a
// pool of the device; trim_pool() returns free memory of the pool to the driver.
// docs/architecture.md, "Memory on the GPU", describes who owns memory and when it is
// freed. Only sources that are built with CUDA include this header.

#include <cuda_runtime.h>

#include <new>
#include <stdexcept>
#include <string>
#include <utility>

#include "base/mutex.h"
#include "base/span.h"

namespace v3dg {
namespace cuda {

// The error for too little device memory. what() has the requested and the free bytes.
// Like every std::bad_alloc, it becomes a MemoryError in Python.
class OutOfMemory : public std::bad_alloc {
  public:
    explicit OutOfMemory(std::string text) : text_(std::move(text)) {}
    const char* what() const noexcept override { return text_.c_str(); }

  private:
    std::string text_;
};

// Throws std::runtime_error with CUDA's error text if `error` is an error. `what` names
// the call.
void check(cudaError_t error, const char* what);

// Returns the number of devices, or 0 if there is no driver.
int num_devices();
int current_device();
// Returns the number of multiprocessors of the current device.
unsigned num_multiprocessors();

// Returns the bytes of shared memory of a multiprocessor.
size_t shared_memory_of_multiprocessor();

// Allows a kernel to use `bytes` of dynamic shared memory on the current device. This
// is needed if its dynamic and static shared memory together exceed 48 KiB. All threads
// share the limit of a kernel. It is never lowered, because another thread may be about
// to launch the kernel. `name` is used in error texts.
void allow_shared_memory(const void* kernel, size_t bytes, const char* name);

// Returns whether the kernel, as compiled for the current device, can start before the
// preceding kernel has ended (launch_early()).
bool can_start_early(const void* kernel);

// Allocates memory of the current device, in the order of the stream. The pool keeps
// freed memory for later calls. Throws OutOfMemory.
void* allocate(size_t bytes, cudaStream_t stream);
// Frees memory of `device` in the order of a stream of that device. Another device may
// be current.
void release(void* pointer, int device, cudaStream_t stream) noexcept;
// Waits for the stream, then returns free memory of the pool to the driver.
void trim_pool(cudaStream_t stream);

// How much memory the pool of the current device holds, and how much of it is in use.
struct PoolBytes {
    size_t reserved, used;
};
PoolBytes pool_bytes();

// Protects captures. While this object exists, calls of this thread that free memory or
// destroy events do not invalidate a graph that another stream is capturing. They occur
// if an object is replaced during a capture.
class KeepsCaptures {
  public:
    KeepsCaptures() { exchange(); }
    ~KeepsCaptures() { exchange(); }
    KeepsCaptures(const KeepsCaptures&) = delete;

  private:
    void exchange() noexcept {
        if (cudaThreadExchangeStreamCaptureMode(&mode_) != cudaSuccess) cudaGetLastError();
    }
    cudaStreamCaptureMode mode_ = cudaStreamCaptureModeRelaxed;
};

bool is_capturing(cudaStream_t stream);
// Throws std::runtime_error if the stream is being captured. During a capture, memory
// cannot be allocated, because it would be freed together with the graph.
void refuse_capture(cudaStream_t stream);

// A mutex for memory that different threads and streams use one after another.
class StreamMutex {
  public:
    StreamMutex();
    ~StreamMutex();
    // Waits until the device has finished the work that was enqueued under the last
    // lock, and thus all earlier work.
    void wait() const noexcept;
    StreamMutex(const StreamMutex&) = delete;
    StreamMutex& operator=(const StreamMutex&) = delete;

  private:
    friend class StreamLock;
    void acquire(cudaStream_t stream, bool is_captured) V3DG_ACQUIRE(busy_);
    void release(cudaStream_t stream, bool is_captured) noexcept V3DG_RELEASE(busy_);

    Mutex busy_;
    cudaEvent_t done_ = nullptr;
    cudaStream_t last_ V3DG_GUARDED_BY(busy_) = nullptr;
};

// Holds a StreamMutex, which no other thread can hold meanwhile. Work that this thread
// enqueues on `stream` runs after the work that was enqueued under the previous lock.
// Captured work is not ordered; the code that replays the graph must order it.
class V3DG_SCOPED_CAPABILITY StreamLock {
  public:
    StreamLock(StreamMutex& mutex, cudaStream_t stream) V3DG_ACQUIRE(mutex.busy_);
    ~StreamLock() V3DG_RELEASE();
    StreamLock(const StreamLock&) = delete;
    StreamLock& operator=(const StreamLock&) = delete;

  private:
    StreamMutex& mutex_;
    cudaStream_t stream_;
    bool is_captured_;
};

// An uninitialised array of a plain type, on the device that is current when it grows.
// When it grows, its contents are lost. If several streams use it, the caller must
// order their work.
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

    // Makes room for `size` elements. Memory is allocated and freed in the order of
    // `stream`.
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
    // Copies elements from host memory, which may be reused when the function returns.
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

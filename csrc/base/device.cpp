// Devices, and the memory pool for stream-ordered allocations.

#include "base/device.h"

#include <map>
#include <string>
#include <utility>
#include <vector>

#include "base/out_of_memory.h"

namespace v3dg {
namespace cuda {

[[noreturn]] static void fail(cudaError_t error, const char* what) {
    // Clear the error, so that a later call does not report it again.
    cudaGetLastError();
    throw std::runtime_error(std::string("cuda: ") + what +
                             " failed: " + cudaGetErrorString(error));
}

void check(cudaError_t error, const char* what) {
    if (error != cudaSuccess) fail(error, what);
}

int num_devices() {
    int count = 0;
    if (cudaGetDeviceCount(&count) != cudaSuccess) {
        cudaGetLastError();
        return 0;
    }
    return count;
}

int current_device() {
    int device = 0;
    check(cudaGetDevice(&device), "cudaGetDevice");
    return device;
}

unsigned num_multiprocessors() {
    int count = 0;
    check(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, current_device()),
          "cudaDeviceGetAttribute");
    return static_cast<unsigned>(count);
}

size_t shared_memory_of_multiprocessor() {
    int bytes = 0;
    check(cudaDeviceGetAttribute(&bytes, cudaDevAttrMaxSharedMemoryPerMultiprocessor,
                                 current_device()),
          "cudaDeviceGetAttribute");
    return static_cast<size_t>(bytes);
}

void allow_shared_memory(const void* kernel, size_t bytes, const char* name) {
    static Mutex mutex;
    static std::map<std::pair<int, const void*>, size_t> allowed_bytes V3DG_GUARDED_BY(mutex);
    int device = 0;
    check(cudaGetDevice(&device), "cudaGetDevice");
    const MutexLock lock(mutex);
    size_t& allowed = allowed_bytes[{device, kernel}];
    if (bytes <= allowed) return;
    check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize,
                               static_cast<int>(bytes)),
          name);
    allowed = bytes;
}

bool can_start_early(const void* kernel) {
    // The first compute capability that supports cudaGridDependencySynchronize().
    constexpr int kFirst = 90;
    static Mutex mutex;
    static std::map<std::pair<int, const void*>, bool> known V3DG_GUARDED_BY(mutex);
    const int device = current_device();
    const MutexLock lock(mutex);
    const auto [found, is_new] = known.try_emplace({device, kernel}, false);
    if (is_new) {
        cudaFuncAttributes attributes{};
        found->second = cudaFuncGetAttributes(&attributes, kernel) == cudaSuccess &&
                        attributes.ptxVersion >= kFirst;
        cudaGetLastError();
    }
    return found->second;
}

// v3dg has its own pool, so that other libraries cannot change how long memory is kept.
static cudaMemPool_t pool_of_current_device() {
    static Mutex mutex;
    static std::vector<cudaMemPool_t> pools V3DG_GUARDED_BY(mutex);
    const int device = current_device();
    const MutexLock lock(mutex);
    if (pools.size() <= static_cast<size_t>(device)) pools.resize(device + 1, nullptr);
    if (pools[device] == nullptr) {
        cudaMemPoolProps properties{};
        properties.allocType = cudaMemAllocationTypePinned;
        properties.location.type = cudaMemLocationTypeDevice;
        properties.location.id = device;
        cudaMemPool_t pool;
        check(cudaMemPoolCreate(&pool, &properties), "cudaMemPoolCreate");
        // Keep up to 1 GiB of freed memory in the pool, because mapping it again takes
        // milliseconds.
        uint64_t keep = uint64_t(1) << 30;
        check(cudaMemPoolSetAttribute(pool, cudaMemPoolAttrReleaseThreshold, &keep),
              "cudaMemPoolSetAttribute");
        pools[device] = pool;
    }
    return pools[device];
}

static std::string mebibytes(size_t bytes) { return std::to_string((bytes >> 20) + 1) + " MiB"; }

void fail_out_of_memory(size_t requested_bytes) {
    cudaGetLastError();
    size_t free_bytes = 0, total = 0;
    check(cudaMemGetInfo(&free_bytes, &total), "cudaMemGetInfo");
    throw OutOfMemory("cuda: out of memory: requested " + mebibytes(requested_bytes) +
                      ", free: " + mebibytes(free_bytes) + " of " + mebibytes(total));
}

void* allocate(size_t bytes, cudaStream_t stream) {
    if (bytes == 0) return nullptr;
    const cudaMemPool_t pool = pool_of_current_device();
    void* pointer = nullptr;
    cudaError_t error = cudaMallocFromPoolAsync(&pointer, bytes, pool, stream);
    if (error == cudaErrorMemoryAllocation) {
        // Try again after waiting. The pool's free memory may be fragmented, and work
        // on other streams may free more.
        cudaGetLastError();
        check(cudaDeviceSynchronize(), "cudaDeviceSynchronize");
        check(cudaMemPoolTrimTo(pool, 0), "cudaMemPoolTrimTo");
        error = cudaMallocFromPoolAsync(&pointer, bytes, pool, stream);
    }
    if (error == cudaErrorMemoryAllocation) fail_out_of_memory(bytes);
    check(error, "cudaMallocFromPoolAsync");
    return pointer;
}

void release(void* pointer, int device, cudaStream_t stream) noexcept {
    if (pointer == nullptr) return;
    const KeepsCaptures keeps_captures;
    int current = device;
    const bool is_elsewhere = cudaGetDevice(&current) == cudaSuccess && current != device &&
                              cudaSetDevice(device) == cudaSuccess;
    // Ignore errors. At exit, the driver may be unloaded already; it has then freed the
    // memory.
    if (cudaFreeAsync(pointer, stream) != cudaSuccess) cudaGetLastError();
    if (is_elsewhere && cudaSetDevice(current) != cudaSuccess) cudaGetLastError();
}

PoolBytes pool_bytes() {
    const cudaMemPool_t pool = pool_of_current_device();
    uint64_t reserved = 0, used = 0;
    check(cudaMemPoolGetAttribute(pool, cudaMemPoolAttrReservedMemCurrent, &reserved),
          "cudaMemPoolGetAttribute");
    check(cudaMemPoolGetAttribute(pool, cudaMemPoolAttrUsedMemCurrent, &used),
          "cudaMemPoolGetAttribute");
    return {reserved, used};
}

bool is_capturing(cudaStream_t stream) {
    cudaStreamCaptureStatus status;
    check(cudaStreamIsCapturing(stream, &status), "cudaStreamIsCapturing");
    return status != cudaStreamCaptureStatusNone;
}

void refuse_capture(cudaStream_t stream) {
    if (is_capturing(stream))
        throw std::runtime_error(
            "cuda: memory cannot be allocated during the capture of a graph; draw the frame once "
            "before the capture");
}

StreamMutex::StreamMutex() {
    check(cudaEventCreateWithFlags(&done_, cudaEventDisableTiming), "cudaEventCreate");
}

StreamMutex::~StreamMutex() {
    if (cudaEventDestroy(done_) != cudaSuccess)
        cudaGetLastError();  // ignore errors, because at exit the driver may be
                             // unloaded already
}

void StreamMutex::wait() const noexcept {
    if (cudaEventSynchronize(done_) != cudaSuccess)
        cudaGetLastError();  // ignore errors, because at exit the driver may be
                             // unloaded already
}

void StreamMutex::acquire(cudaStream_t stream, bool is_captured) {
    busy_.lock();
    if (is_captured || stream == last_) return;
    const cudaError_t error = cudaStreamWaitEvent(stream, done_, 0);
    if (error == cudaSuccess) return;
    busy_.unlock();
    fail(error, "cudaStreamWaitEvent");
}

void StreamMutex::release(cudaStream_t stream, bool is_captured) noexcept {
    if (!is_captured) {
        last_ = stream;
        if (cudaEventRecord(done_, stream) != cudaSuccess)
            cudaGetLastError();  // the next lock reports the error
    }
    busy_.unlock();
}

// The constructor and the destructor only call other functions, because Clang's
// thread-safety analysis skips constructors and destructors.
StreamLock::StreamLock(StreamMutex& mutex, cudaStream_t stream)
    : mutex_(mutex), stream_(stream), is_captured_(is_capturing(stream)) {
    mutex.acquire(stream, is_captured_);
}

StreamLock::~StreamLock() { mutex_.release(stream_, is_captured_); }

void trim_pool(cudaStream_t stream) {
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
    check(cudaMemPoolTrimTo(pool_of_current_device(), 0), "cudaMemPoolTrimTo");
}

}  // namespace cuda
}  // namespace v3dg

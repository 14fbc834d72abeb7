// Implements mapped_memory.h with functions of the driver. They are looked up through
// the runtime, so that the module also loads on machines without a driver.

#include "base/mapped_memory.h"

#include <cuda.h>

#include <string>
#include <utility>

#include "base/out_of_memory.h"

namespace v3dg {
namespace cuda {
namespace {

struct Driver {
    decltype(&cuDeviceGetAttribute) get_attribute = nullptr;
    decltype(&cuMemGetAllocationGranularity) get_granularity = nullptr;
    decltype(&cuMemAddressReserve) reserve_range = nullptr;
    decltype(&cuMemAddressFree) free_range = nullptr;
    decltype(&cuMemCreate) create = nullptr;
    decltype(&cuMemRelease) release = nullptr;
    decltype(&cuMemMap) map = nullptr;
    decltype(&cuMemUnmap) unmap = nullptr;
    decltype(&cuMemSetAccess) set_access = nullptr;

    bool is_complete() const {
        return get_attribute != nullptr && get_granularity != nullptr && reserve_range != nullptr &&
               free_range != nullptr && create != nullptr && release != nullptr && map != nullptr &&
               unmap != nullptr && set_access != nullptr;
    }
};

template <class F>
void find(const char* name, F& function) {
    void* found = nullptr;
    cudaDriverEntryPointQueryResult result = cudaDriverEntryPointSymbolNotFound;
#if CUDART_VERSION >= 12050
    constexpr unsigned kVersion = 11020;  // a CUDA version in which all of these
                                          // functions exist
    const cudaError_t error =
        cudaGetDriverEntryPointByVersion(name, &found, kVersion, cudaEnableDefault, &result);
#else
    const cudaError_t error = cudaGetDriverEntryPoint(name, &found, cudaEnableDefault, &result);
#endif
    if (error != cudaSuccess) cudaGetLastError();
    const bool exists = error == cudaSuccess && result == cudaDriverEntryPointSuccess;
    function = exists ? reinterpret_cast<F>(found) : nullptr;
}

Driver found_driver() {
    Driver driver;
    find("cuDeviceGetAttribute", driver.get_attribute);
    find("cuMemGetAllocationGranularity", driver.get_granularity);
    find("cuMemAddressReserve", driver.reserve_range);
    find("cuMemAddressFree", driver.free_range);
    find("cuMemCreate", driver.create);
    find("cuMemRelease", driver.release);
    find("cuMemMap", driver.map);
    find("cuMemUnmap", driver.unmap);
    find("cuMemSetAccess", driver.set_access);
    return driver;
}

const Driver& driver() {
    static const Driver found = found_driver();
    return found;
}

void check_driver(CUresult result, const char* what) {
    if (result != CUDA_SUCCESS)
        throw std::runtime_error(std::string("cuda: ") + what + " failed with error " +
                                 std::to_string(int(result)) + " of the driver");
}

CUmemAllocationProp properties_of(int device) {
    CUmemAllocationProp properties{};
    properties.type = CU_MEM_ALLOCATION_TYPE_PINNED;
    properties.location.type = CU_MEM_LOCATION_TYPE_DEVICE;
    properties.location.id = device;
    return properties;
}

size_t rounded_up(size_t bytes, size_t step) { return (bytes + step - 1) / step * step; }

size_t granularity_of(int device) {
    const CUmemAllocationProp properties = properties_of(device);
    size_t bytes = 0;
    check_driver(
        driver().get_granularity(&bytes, &properties, CU_MEM_ALLOC_GRANULARITY_RECOMMENDED),
        "cuMemGetAllocationGranularity");
    return bytes;
}

// Returns memory of a device; throws OutOfMemory.
CUmemGenericAllocationHandle create_memory(size_t bytes, int device, cudaStream_t stream) {
    const CUmemAllocationProp properties = properties_of(device);
    CUmemGenericAllocationHandle memory = 0;
    CUresult result = driver().create(&memory, bytes, &properties, 0);
    if (result == CUDA_ERROR_OUT_OF_MEMORY) {
        // Try again, because the pool may have free memory after waiting.
        check(cudaDeviceSynchronize(), "cudaDeviceSynchronize");
        trim_pool(stream);
        result = driver().create(&memory, bytes, &properties, 0);
    }
    if (result == CUDA_ERROR_OUT_OF_MEMORY) fail_out_of_memory(bytes);
    check_driver(result, "cuMemCreate");
    return memory;
}

// Maps new memory at an address.
void map_memory(CUdeviceptr at, size_t bytes, int device, cudaStream_t stream) {
    const CUmemGenericAllocationHandle memory = create_memory(bytes, device, stream);
    const CUresult mapped = driver().map(at, bytes, 0, memory, 0);
    // The mapping keeps the memory alive.
    driver().release(memory);
    check_driver(mapped, "cuMemMap");
    CUmemAccessDesc access{};
    access.location = properties_of(device).location;
    access.flags = CU_MEM_ACCESS_FLAGS_PROT_READWRITE;
    const CUresult accessible = driver().set_access(at, bytes, &access, 1);
    if (accessible != CUDA_SUCCESS) driver().unmap(at, bytes);
    check_driver(accessible, "cuMemSetAccess");
}

}  // namespace

bool MappedMemory::is_supported() {
    const Driver& functions = driver();
    int is_supported = 0;
    return functions.is_complete() &&
           functions.get_attribute(&is_supported,
                                   CU_DEVICE_ATTRIBUTE_VIRTUAL_MEMORY_MANAGEMENT_SUPPORTED,
                                   current_device()) == CUDA_SUCCESS &&
           is_supported != 0;
}

void* MappedMemory::reserve(size_t bytes, cudaStream_t stream) {
    if (bytes <= num_bytes_) return data();
    if (first_ == 0) {
        device_ = current_device();
        size_t free_bytes = 0, total = 0;
        check(cudaMemGetInfo(&free_bytes, &total), "cudaMemGetInfo");
        const size_t range = rounded_up(total, granularity_of(device_));
        check_driver(driver().reserve_range(&first_, range, 0, 0, 0), "cuMemAddressReserve");
        range_bytes_ = range;
    }
    const size_t after = rounded_up(bytes, granularity_of(device_));
    if (after > range_bytes_) fail_out_of_memory(bytes);
    piece_bytes_.reserve(piece_bytes_.size() + 1);
    map_memory(first_ + num_bytes_, after - num_bytes_, device_, stream);
    piece_bytes_.push_back(after - num_bytes_);
    num_bytes_ = after;
    return data();
}

MappedMemory::~MappedMemory() {
    if (first_ == 0) return;
    const KeepsCaptures keeps_captures;
    // Ignore errors. At exit, the driver may be unloaded already; it has then freed the
    // memory.
    CUdeviceptr piece = first_;
    for (const size_t bytes : piece_bytes_) {
        driver().unmap(piece, bytes);
        piece += bytes;
    }
    driver().free_range(first_, range_bytes_);
}

void MappedMemory::swap(MappedMemory& other) noexcept {
    std::swap(first_, other.first_);
    std::swap(range_bytes_, other.range_bytes_);
    std::swap(num_bytes_, other.num_bytes_);
    std::swap(piece_bytes_, other.piece_bytes_);
    std::swap(device_, other.device_);
}

}  // namespace cuda
}  // namespace v3dg

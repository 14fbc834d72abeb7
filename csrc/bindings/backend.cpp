// Maps devices to backends. This file has the only #if of the bindings that depends on
// a backend.

#include "bindings/backend.h"

namespace v3dg {

const Backend* device_backend() {
#if V3DG_WITH_CUDA
    return &cuda_backend();
#else
    return nullptr;
#endif
}

const Backend& backend_of(Device device) {
    if (device.number < 0) return host_backend();
    const Backend* const backend = device_backend();
    if (backend == nullptr) throw std::runtime_error(std::string("device: ") + kWithoutCuda);
    return *backend;
}

void check_is_on_host(Device device, const char* name, const char* problem) {
    if (device.number >= 0) refuse_value(name, problem);
}

}  // namespace v3dg

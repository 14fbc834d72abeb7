#pragma once

// Changes the current device of a thread within a scope.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Makes a device current in this thread during its lifetime. Streams that are used
// meanwhile must belong to the device.
class DeviceGuard {
  public:
    explicit DeviceGuard(int device) : device_(device), before_(current_device()) {
        if (device_ != before_) check(cudaSetDevice(device_), "cudaSetDevice");
    }
    ~DeviceGuard() {
        if (device_ != before_ && cudaSetDevice(before_) != cudaSuccess) cudaGetLastError();
    }
    DeviceGuard(const DeviceGuard&) = delete;
    DeviceGuard& operator=(const DeviceGuard&) = delete;

  private:
    const int device_, before_;
};

}  // namespace cuda
}  // namespace v3dg

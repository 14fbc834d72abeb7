#pragma once

// Changes the current device of a thread within a scope.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Makes a device current in this thread until the end of the scope. All streams that
// are used in the scope must belong to this device.
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

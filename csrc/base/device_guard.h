#pragma once

// Switches the current device of a thread for a while.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Makes a device the current one of this thread for as long as the guard lives. Streams that are
// used meanwhile have to belong to that device.
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

#pragma once

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Makes a device the current one while it lives.
class DeviceGuard {
  public:
    explicit DeviceGuard(int device) {
        check(cudaGetDevice(&before_), "cudaGetDevice");
        if (device != before_) check(cudaSetDevice(device), "cudaSetDevice");
        is_changed_ = device != before_;
    }
    ~DeviceGuard() {
        if (is_changed_) cudaSetDevice(before_);
    }
    DeviceGuard(const DeviceGuard&) = delete;
    DeviceGuard& operator=(const DeviceGuard&) = delete;

  private:
    int before_ = 0;
    bool is_changed_ = false;
};

}  // namespace cuda
}  // namespace v3dg

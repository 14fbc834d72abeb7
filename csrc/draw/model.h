#pragma once

#include "base/buffer.h"
#include "base/parallel_for.h"
#include "math/gaussian.h"

namespace v3dg {

// The gaussians of a model. Each component is stored in an array (a plane), which the
// model owns.
template <class T>
class Model {
  public:
    explicit Model(const GaussianRows<const T>& rows) : size_(rows.size) {
        const size_t stride = size_ + kPlanePadding;
        T* plane = storage_.reserve((11 + rows.num_sh()) * stride);
        const auto add = [&](const T* source, size_t width, const T** planes) {
            for (size_t k = 0; k < width; ++k) {
                planes[k] = plane;
                parallel_for(size_, 65536, [&, k](size_t i) { plane[i] = source[i * width + k]; });
                for (size_t i = size_; i < stride; ++i) plane[i] = T(0);
                plane += stride;
            }
        };
        add(rows.means, 3, planes_.mean);
        add(rows.quats, 4, planes_.quat);
        add(rows.scales, 3, planes_.scale);
        add(rows.opacities, 1, &planes_.opacity);
        add(rows.sh, rows.num_sh(), planes_.sh);
        planes_.sh_degree = rows.sh_degree;
    }
    const GaussianPlanes<T>& planes() const { return planes_; }
    size_t size() const { return size_; }
    size_t bytes() const { return storage_.capacity() * sizeof(T); }

  private:
    size_t size_;
    Buffer<T> storage_;
    GaussianPlanes<T> planes_{};
};

}  // namespace v3dg

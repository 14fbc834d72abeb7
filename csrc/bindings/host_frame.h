#pragma once

// Models, palettes, pools and frames on the host.

#include <algorithm>

#include "bindings/resident.h"
#include "draw/model.h"

namespace v3dg::host {

// The gaussians that frames on the host read. They are either planes, which this object
// owns, or the codes of a bundle, which it borrows.
class HostModel final : public backend::Model {
  public:
    explicit HostModel(const GaussianRows<const float>& rows);
    explicit HostModel(const py::object& codes);

    size_t size() const { return size_; }
    const GaussianPlanes<float>* planes() const {
        return planes_ == nullptr ? nullptr : &planes_->planes();
    }
    const Codes* codes() const { return planes_ == nullptr ? &codes_ : nullptr; }

    size_t bytes() const override;
    void decode(Span<const int32_t> clusters, Span<const int64_t> offset, const Work& work,
                const GaussianRows<float>& out) const override;

  private:
    size_t size_ = 0;
    std::unique_ptr<::v3dg::Model<float>> planes_;
    py::object codes_object_;  // owns the memory of `codes_`
    Codes codes_{};
};

class HostPalette final : public backend::Palette {
  public:
    HostPalette(const py::object& table, const py::array& sh);
    const ::v3dg::Palette& palette() const { return palette_; }

  private:
    py::object table_;
    py::array sh_;
    ::v3dg::Palette palette_;
};

std::unique_ptr<backend::Pool> make_pool(PagePool& pool);
std::unique_ptr<backend::Frame> make_frame();
std::unique_ptr<backend::AssetFrame> make_asset_frame(std::shared_ptr<const backend::Model> model,
                                                      Appearance<float> appearance);

std::unique_ptr<backend::RayFrame> make_ray_frame();

// Like new_elements(), but sets all elements to zero.
template <class T>
T* zeros(const Shape& shape, py::object& object) {
    const NewArray<T> array(kHost, shape);
    std::fill(array.span.begin(), array.span.end(), T(0));
    object = array.object;
    return array.span.data;
}

// Implements Backend::rasterize() for float32 and float64.
Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape);

}  // namespace v3dg::host

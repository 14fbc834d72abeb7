#pragma once

// The values that Python passes to the core. They are immutable, and keep alive the
// arrays that they borrow from.

#include <array>

#include "bindings/array.h"
#include "camera/camera.h"
#include "frame/image.h"
#include "math/gaussian.h"
#include "select/select.h"

namespace v3dg {

// A camera that draws its whole image or a part, and the view matrix that it was made
// from.
struct BoundCamera {
    std::array<double, 16> viewmat;
    Camera camera;

    int width() const { return static_cast<int>(camera.width); }
    int height() const { return static_cast<int>(camera.height); }
};

// A camera, or the two eyes of a stereo camera.
struct BoundEyes {
    Eyes eyes;
};

// Throws ValueError unless the rule's footprint is defined for the cameras. The paper's
// footprint is only defined for one pinhole camera.
void check_footprint(const Eyes& eyes, const SelectRule& rule);

// The arrays of gaussians, either all on the host or all on one CUDA device. They are
// float32 or, on the host, may be float64.
class Rows {
  public:
    Rows(py::object means, py::object quats, py::object scales, py::object opacities,
         py::object sh);

    Device device() const { return device_; }
    size_t size() const { return size_; }
    int sh_degree() const { return sh_degree_; }
    bool is_double() const { return is_double_; }
    const std::array<py::object, 5>& arrays() const { return arrays_; }

    // Borrows the arrays, whose precision must be T.
    template <class T>
    GaussianRows<const T> read() const {
        check_precision(std::is_same<T, double>::value);
        const auto at = [&](int k) { return static_cast<const T*>(memory_[k]); };
        return {at(0), at(1), at(2), at(3), at(4), size_, sh_degree_};
    }
    // Borrows the arrays for writing. They must be float32.
    GaussianRows<float> write() const { return spans<float>(); }

  private:
    template <class T>
    GaussianRows<T> spans() const {
        const auto n = static_cast<py::ssize_t>(size_),
                   bases = static_cast<py::ssize_t>(num_sh_bases(sh_degree_));
        return {span_on<T>(device_, arrays_[0], "means", {n, 3}).data,
                span_on<T>(device_, arrays_[1], "quats", {n, 4}).data,
                span_on<T>(device_, arrays_[2], "scales", {n, 3}).data,
                span_on<T>(device_, arrays_[3], "opacities", {n}).data,
                span_on<T>(device_, arrays_[4], "sh", {n, bases, 3}).data,
                size_,
                sh_degree_};
    }

    template <class T>
    void remember(const GaussianRows<T>& rows) {
        memory_ = {rows.means, rows.quats, rows.scales, rows.opacities, rows.sh};
    }
    void check_precision(bool wants_double) const;

    std::array<py::object, 5> arrays_;
    std::array<const void*, 5> memory_{};
    Device device_;
    size_t size_ = 0;
    int sh_degree_ = 0;
    bool is_double_ = false;
};

// New, uninitialised arrays for `size` gaussians.
struct NewRows {
    NewArray<float> means, quats, scales, opacities, sh;
    size_t size;
    int sh_degree;

    NewRows(Device device, size_t size, int sh_degree);
    GaussianRows<float> rows() const {
        return {means.span.data,  quats.span.data,
                scales.span.data, opacities.span.data,
                sh.span.data,     size,
                sh_degree};
    }
    py::tuple arrays() const {
        return py::make_tuple(means.object, quats.object, scales.object, opacities.object,
                              sh.object);
    }
};

// Returns the SH degree that has this number of bases. `shape` is for the error text.
int degree_of_bases(py::ssize_t bases, const std::string& shape);

// The instances of a scene, in host memory.
class Instances {
  public:
    Instances(py::array bundle, py::array positions, py::array quaternions, py::array scales,
              py::array importance, py::object factors);
    const InstanceTable& table() const { return table_; }
    // Throws unless the bundle of every instance is below `num_bundles`.
    void check_bundles(size_t num_bundles) const;

  private:
    std::array<py::object, 6> arrays_;
    InstanceTable table_;
};
// Returns (I, 4) factors of red, green, blue and opacity. None gives an empty span.
Span<const InstanceFactors> factors_of(const py::object& factors, py::ssize_t count);
void check_instance_bundles(Span<const int32_t> bundle, size_t num_bundles);

// Returns the boundaries of segments, which must ascend from 0 to `last`.
Span<const int64_t> offsets_of(const py::handle& offset, size_t last);

// Throws ValueError unless the size of an image is valid.
void check_image_size(int width, int height);

// Returns the part of the camera's image that is drawn.
Window window_of(const Camera& camera);

}  // namespace v3dg

#pragma once

// The slopes x / z and y / z of the rays through the pixel centres of a pinhole.

#include "camera/pinhole.h"

namespace v3dg {

class PixelSlopes {
  public:
    V3DG_HD explicit PixelSlopes(const Pinhole<double>& camera) : camera_(camera) {}

    V3DG_HD double x_of(double column) const { return (column + 0.5 - camera_.cx) / camera_.fx; }
    V3DG_HD double y_of(double row) const { return (row + 0.5 - camera_.cy) / camera_.fy; }
    V3DG_HD double near_depth() const { return camera_.near_depth; }

  private:
    Pinhole<double> camera_;
};

}  // namespace v3dg

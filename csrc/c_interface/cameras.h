#pragma once

// The cameras of the C library.

#include <string>

#include <v3dg.h>
#include "camera/camera.h"

namespace v3dg {

// Throws Fault for a value that v3dg_camera does not allow. The limit of the image's
// size is not checked here, because it only applies to selection.
void check_camera(const v3dg_camera& camera);

// Returns the camera for selection. Throws Fault like check_camera(), or if the picture
// is too large.
Camera selecting_camera(const v3dg_camera& camera);

// Returns the eyes of one or two cameras. Throws Fault if they cannot share a cut.
Eyes eyes_of(const v3dg_camera* cameras, uint32_t count);

// Returns a pinhole camera at `eye` that looks at `target`. Throws Fault if the points
// and angles do not define one.
v3dg_camera camera_looking_at(const double eye[3], const double target[3], const double up[3],
                              double fov_x, int32_t width, int32_t height, double near_depth);

}  // namespace v3dg

// Checks cameras, with the error texts of Python (v3dg/cameras.py), and converts them
// to cameras of the core.

#include "c_interface/cameras.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "c_interface/fault.h"
#include "camera/camera_arrays.h"

namespace v3dg {

namespace {

constexpr int kMostSide = UINT16_MAX;
constexpr int kNumOpenCvTerms = 8;
constexpr int kNumFisheyeTerms = 4;

// A matrix of intrinsics.
struct CameraMatrix {
    double values[9];

    explicit CameraMatrix(const v3dg_camera& camera)
        : values{camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1} {}
};

std::string short_text(double number) {
    char text[32];
    std::snprintf(text, sizeof text, "%g", number);
    return text;
}

std::string text_of_vector(const double* v, int count) {
    std::string text;
    for (int k = 0; k < count; ++k) text += (k > 0 ? ", " : "") + short_text(v[k]);
    return "(" + text + ")";
}

void check_finite(const double* values, int count, const char* name) {
    for (int k = 0; k < count; ++k)
        check_argument(std::isfinite(values[k]), name, "finite numbers, got " + text_of(values[k]));
}

void check_lens(const v3dg_camera& camera) {
    const int32_t lens = camera.lens;
    check_argument(lens >= V3DG_PINHOLE && lens <= V3DG_FISHEYE, "lens",
                   "V3DG_PINHOLE, V3DG_OPENCV or V3DG_FISHEYE, got " + std::to_string(lens));
    check_finite(camera.distortion, kNumOpenCvTerms, "distortion");
    const int count = lens == V3DG_PINHOLE  ? 0
                      : lens == V3DG_OPENCV ? kNumOpenCvTerms
                                            : kNumFisheyeTerms;
    for (int k = count; k < kNumOpenCvTerms; ++k)
        check_argument(camera.distortion[k] == 0, "distortion",
                       std::to_string(count) + " coefficients of this lens and then zeros, got " +
                           text_of(camera.distortion[k]) + " behind them");
}

void check_side(int32_t side, const char* name) {
    check_argument(side > 0, name, "a positive whole number, got " + std::to_string(side));
}

bool is_distorted(const v3dg_camera& camera) {
    if (camera.lens == V3DG_FISHEYE) return true;
    const double* end = camera.distortion + kNumOpenCvTerms;
    return std::any_of(camera.distortion, end, [](double value) { return value != 0; });
}

Intrinsics<double> lens_of(const v3dg_camera& camera, const Pinhole<double>& projection) {
    if (!is_distorted(camera)) return intrinsics_of(projection);
    const double* d = camera.distortion;
    if (camera.lens == V3DG_FISHEYE) return intrinsics_of_fisheye(projection, d);
    // OpenCV's order is k1, k2, p1, p2, k3 to k6. The core's order is k1 to k6, p1, p2.
    const double terms[kNumOpenCvTerms] = {d[0], d[1], d[4], d[5], d[6], d[7], d[2], d[3]};
    return intrinsics_of_opencv(projection, terms);
}

void cross(const double a[3], const double b[3], double out[3]) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

double length_of(const double v[3]) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

double focal_length(double fov, int32_t side) {
    const double tangent = std::tan(0.5 * fov);
    const bool is_angle = fov > 0 && fov < M_PI && tangent > 0;
    const double focal = is_angle ? 0.5 * side / tangent : INFINITY;
    check_argument(focal < INFINITY, "fov_x", "radians between 0 and pi, got " + text_of(fov));
    return focal;
}

}  // namespace

void check_camera(const v3dg_camera& camera) {
    const CameraMatrix matrix(camera);
    check_finite(camera.viewmat, 16, "viewmat");
    check_finite(matrix.values, 9, "K");
    switch (fault_of_camera(camera.viewmat, matrix.values)) {
        case CameraFault::last_row:
            check_argument(false, "viewmat",
                           "the last row 0 0 0 1, got " + text_of_vector(camera.viewmat + 12, 4));
            break;
        case CameraFault::focal_length:
            check_argument(false, "K",
                           "positive focal lengths, got " + short_text(camera.fx) + " and " +
                               short_text(camera.fy));
            break;
        case CameraFault::none: break;
        default:
            check_argument(false, "viewmat",
                           "a rotation in the upper left 3x3, got a matrix that scales, shears or "
                           "mirrors; put scale into the scene instead");
    }
    check_side(camera.width, "width");
    check_side(camera.height, "height");
    check_argument(camera.near_depth > 0 && std::isfinite(camera.near_depth), "near",
                   "a positive number, got " + text_of(camera.near_depth));
    check_lens(camera);
}

Camera selecting_camera(const v3dg_camera& camera) {
    check_camera(camera);
    check_argument(camera.width <= kMostSide && camera.height <= kMostSide, "width, height",
                   "1 to 65535 px, got " + std::to_string(camera.width) + " x " +
                       std::to_string(camera.height));
    Camera out = camera_of(camera.viewmat, CameraMatrix(camera).values, camera.width, camera.height,
                           camera.near_depth);
    out.set_lens(lens_of(camera, out.pinhole()));
    return out;
}

Eyes eyes_of(const v3dg_camera* cameras, uint32_t count) {
    check_argument(count == 1 || count == 2, "num_eyes", "1 or 2, got " + std::to_string(count));
    check_argument(cameras != nullptr, "eyes", "cameras, got NULL");
    const Camera left = selecting_camera(cameras[0]);
    if (count == 1) return Eyes(left);
    const Camera right = selecting_camera(cameras[1]);
    check_argument(std::equal(left.rotation, left.rotation + 9, right.rotation), "right",
                   "a camera of the same rotation as the left one, got another; select for "
                   "cameras with different rotations one by one");
    const std::pair<const char*, const Camera*> eyes[] = {{"left", &left}, {"right", &right}};
    for (const auto& [name, eye] : eyes)
        check_argument(eye->is_pinhole(), name,
                       "a pinhole, got a lens with distortion; select for such cameras one by one");
    return Eyes(left, right);
}

v3dg_camera camera_looking_at(const double eye[3], const double target[3], const double up[3],
                              double fov_x, int32_t width, int32_t height, double near_depth) {
    check_finite(eye, 3, "eye");
    check_finite(target, 3, "target");
    check_finite(up, 3, "up");
    double rows[3][3];  // right, down and forward
    for (int k = 0; k < 3; ++k) rows[2][k] = target[k] - eye[k];
    const double distance = length_of(rows[2]);
    check_argument(distance > 0, "target",
                   "a point away from the eye, got " + text_of_vector(target, 3) + " for both");
    check_argument(std::isfinite(distance), "eye, target",
                   "points whose distance a double can hold, got " + text_of_vector(eye, 3) +
                       " and " + text_of_vector(target, 3));
    for (double& value : rows[2]) value /= distance;
    double largest = 0;
    for (int k = 0; k < 3; ++k) largest = std::max(largest, std::fabs(up[k]));
    double upwards[3];  // divided by the largest element, so that squares neither
                        // overflow nor underflow
    for (int k = 0; k < 3; ++k) upwards[k] = up[k] / (largest > 0 ? largest : 1);
    cross(rows[2], upwards, rows[0]);
    const double length = length_of(rows[0]);
    check_argument(length > 1e-9 * length_of(upwards), "up",
                   "a direction that is not along the view, got " + text_of_vector(up, 3));
    for (double& value : rows[0]) value /= length;
    cross(rows[2], rows[0], rows[1]);
    check_side(width, "width");
    check_side(height, "height");
    v3dg_camera camera{};
    for (int i = 0; i < 3; ++i) {
        std::copy_n(rows[i], 3, camera.viewmat + 4 * i);
        camera.viewmat[4 * i + 3] =
            -(rows[i][0] * eye[0] + rows[i][1] * eye[1] + rows[i][2] * eye[2]);
    }
    camera.viewmat[15] = 1;
    camera.fx = focal_length(fov_x, width);
    camera.fy = camera.fx;
    camera.cx = 0.5 * width;
    camera.cy = 0.5 * height;
    camera.near_depth = near_depth;
    camera.width = width;
    camera.height = height;
    check_camera(camera);
    return camera;
}

}  // namespace v3dg

// The arithmetic of poses. Quaternions are computed with the operations of the Python
// module in the same order, so the results are equal to the last bit. Similarity
// transforms use other algorithms, whose results are equal up to rounding.

#include "c_interface/placing.h"

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdio>
#include <map>

#include "c_interface/fault.h"

namespace v3dg {

namespace {

const double kHalf = std::sqrt(0.5);

// The largest relative difference between a matrix and a similarity transform.
constexpr double kSimilar = 1e-4;

// Rotations of each axis to -y.
const std::map<std::string, Quaternion>& turns_upright() {
    static const std::map<std::string, Quaternion> turns = {
        {"x", {kHalf, 0, 0, -kHalf}}, {"y", {0, 1, 0, 0}},  {"z", {kHalf, kHalf, 0, 0}},
        {"-x", {kHalf, 0, 0, kHalf}}, {"-y", {1, 0, 0, 0}}, {"-z", {kHalf, -kHalf, 0, 0}},
    };
    return turns;
}

struct Matrix3 {
    double m[3][3];

    double determinant() const {
        return m[0][0] * cofactor(0, 0) + m[0][1] * cofactor(0, 1) + m[0][2] * cofactor(0, 2);
    }
    double cofactor(int i, int j) const {
        const int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
        return m[a][c] * m[b][d] - m[a][d] * m[b][c];
    }
};

Matrix3 rotation_of(const double quaternion[4]) {
    const double w = quaternion[0], x = quaternion[1], y = quaternion[2], z = quaternion[3];
    return {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
             {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
             {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

// Returns the nearest rotation by Newton's iteration. Precondition: the matrix is a
// similarity transform up to kSimilar, with a scale near 1.
Matrix3 nearest_rotation(Matrix3 matrix) {
    for (int step = 0; step < 8; ++step) {
        const double inverse = 1 / matrix.determinant();
        Matrix3 next;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                next.m[i][j] = 0.5 * (matrix.m[i][j] + matrix.cofactor(i, j) * inverse);
        matrix = next;
    }
    return matrix;
}

// Returns the quaternion of a rotation, with w >= 0. It divides by the largest of the
// four components, so that there is no cancellation.
Quaternion quaternion_of(const Matrix3& rotation) {
    const auto& m = rotation.m;
    const double squares[4] = {1 + m[0][0] + m[1][1] + m[2][2], 1 + m[0][0] - m[1][1] - m[2][2],
                               1 - m[0][0] + m[1][1] - m[2][2], 1 - m[0][0] - m[1][1] + m[2][2]};
    const double wx = m[2][1] - m[1][2], wy = m[0][2] - m[2][0], wz = m[1][0] - m[0][1],
                 xy = m[1][0] + m[0][1], xz = m[0][2] + m[2][0], yz = m[2][1] + m[1][2];
    const double products[4][4] = {{squares[0], wx, wy, wz},
                                   {wx, squares[1], xy, xz},
                                   {wy, xy, squares[2], yz},
                                   {wz, xz, yz, squares[3]}};
    const auto largest = std::max_element(squares, squares + 4) - squares;
    Quaternion out;
    std::copy_n(products[largest], 4, out.begin());
    out = normalised(out);
    if (out[0] < 0)
        for (double& value : out) value = -value;
    return out;
}

[[noreturn]] void refuse_matrix(const std::string& kind) {
    throw Fault(V3DG_ERROR_ARGUMENT,
                "matrix: expected a rotation, a translation and one positive scale, got " + kind +
                    "; instances cannot be stretched, sheared or mirrored");
}

std::string texts_of(const double* numbers, int count) {
    std::string text;
    for (int k = 0; k < count; ++k) {
        char number[32];
        std::snprintf(number, sizeof number, "%g", numbers[k]);
        if (k > 0) text += ' ';
        text += number;
    }
    return text;
}

double largest_of(const Matrix3& matrix) {
    double largest = 0;
    for (const auto& row : matrix.m)
        for (const double value : row) largest = std::max(largest, std::fabs(value));
    return largest;
}

double dot_of_columns(const Matrix3& a, int i, int j) {
    return a.m[0][i] * a.m[0][j] + a.m[1][i] * a.m[1][j] + a.m[2][i] * a.m[2][j];
}

// Throws unless the linear part is a rotation and a uniform scale. Its largest element
// was divided by `largest`.
void check_similarity(const Matrix3& linear, double largest) {
    double scales[3];
    for (int j = 0; j < 3; ++j) scales[j] = std::sqrt(dot_of_columns(linear, j, j));
    const auto [least, most] = std::minmax({scales[0], scales[1], scales[2]});
    if (!(least > 0)) refuse_matrix("a scale of 0 along an axis");
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < i; ++j)
            if (std::fabs(dot_of_columns(linear, i, j)) > kSimilar * scales[i] * scales[j])
                refuse_matrix("a shear");
    const bool is_uniform = most - least <= kSimilar * most;
    for (double& scale : scales) scale *= largest;
    if (!is_uniform) refuse_matrix("different scales: " + texts_of(scales, 3));
    if (!(linear.determinant() > 0)) refuse_matrix("a reflection");
}

}  // namespace

std::string names_of_axes() { return "'x' or 'y' or 'z' or '-x' or '-y' or '-z'"; }

bool is_axis(const std::string& name) { return turns_upright().count(name) > 0; }

Quaternion normalised(const Quaternion& quaternion) {
    double largest = 0;
    for (const double value : quaternion) largest = std::max(largest, std::fabs(value));
    Quaternion unit;
    for (int k = 0; k < 4; ++k) unit[k] = quaternion[k] / largest;
    const double length =
        std::sqrt(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2] + unit[3] * unit[3]);
    for (double& value : unit) value /= length;
    return unit;
}

Quaternion product(const Quaternion& p, const Quaternion& q) {
    return {p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]};
}

Quaternion turn_between(const std::string& up, const std::string& target) {
    const Quaternion& to = turns_upright().at(target);
    return product({to[0], -to[1], -to[2], -to[3]}, turns_upright().at(up));
}

v3dg_instance checked_instance(const v3dg_instance& instance, const std::string& name) {
    const auto check = [&](bool holds, const char* field, const char* expected, double value) {
        check_argument(holds, name + field, std::string(expected) + ", got " + text_of(value));
    };
    for (const double value : instance.position)
        check(std::isfinite(value), "position", "finite numbers", value);
    bool is_zero = true;
    for (const double value : instance.quaternion) {
        check(std::isfinite(value), "quaternion", "finite numbers", value);
        is_zero = is_zero && value == 0;
    }
    check_argument(!is_zero, name + "quaternion", "a nonzero quaternion, got zeros");
    const double scale = instance.scale;
    check(scale > 0 && std::isfinite(scale), "scale", "a positive number", scale);
    const float importance = instance.importance;
    check(importance > 0 && std::isfinite(importance), "importance",
          "a positive number that a float32 can hold", importance);
    check(instance.opacity >= 0 && instance.opacity <= 1, "opacity", "a number from 0 to 1",
          instance.opacity);
    for (const float value : instance.tint)
        check(value >= 0 && std::isfinite(value), "tint",
              "3 numbers of at least 0 that a float32 can hold", value);
    const int32_t environment = instance.environment;
    check(environment >= kSharedEnvironment && environment <= kMostEnvironment, "environment",
          "a whole number from -1 to 16777215", environment);
    v3dg_instance out = instance;
    const double* q = instance.quaternion;
    const Quaternion unit = normalised({q[0], q[1], q[2], q[3]});
    std::copy(unit.begin(), unit.end(), out.quaternion);
    return out;
}

v3dg_instance composed(const v3dg_instance& outer, const v3dg_instance& inner,
                       const std::string& name) {
    v3dg_instance out = inner;
    const Matrix3 rotation = rotation_of(outer.quaternion);
    for (int k = 0; k < 3; ++k) {
        double sum = 0;
        for (int j = 0; j < 3; ++j) sum += rotation.m[k][j] * (outer.scale * inner.position[j]);
        out.position[k] = sum + outer.position[k];
    }
    const double *p = outer.quaternion, *q = inner.quaternion;
    const Quaternion turn = product({p[0], p[1], p[2], p[3]}, {q[0], q[1], q[2], q[3]});
    std::copy(turn.begin(), turn.end(), out.quaternion);
    out.scale = outer.scale * inner.scale;
    out.importance = outer.importance * inner.importance;
    out.opacity = outer.opacity * inner.opacity;
    for (int k = 0; k < 3; ++k) out.tint[k] = outer.tint[k] * inner.tint[k];
    if (outer.environment >= 0) out.environment = outer.environment;
    return checked_instance(out, name);
}

void set_similarity(const double matrix[16], v3dg_instance& instance) {
    for (int k = 0; k < 16; ++k)
        check_argument(std::isfinite(matrix[k]), "matrix",
                       "finite numbers, got " + text_of(matrix[k]));
    for (int k = 0; k < 4; ++k)
        if (std::fabs(matrix[12 + k] - (k == 3 ? 1 : 0)) > kSimilar)
            refuse_matrix("the last row " + texts_of(matrix + 12, 4));
    Matrix3 linear;
    for (int i = 0; i < 3; ++i) std::copy_n(matrix + 4 * i, 3, linear.m[i]);
    const double largest = largest_of(linear);
    if (!(largest > 0)) refuse_matrix("a scale of 0");
    for (auto& row : linear.m)
        for (double& value : row) value /= largest;
    check_similarity(linear, largest);
    const Matrix3 rotation = nearest_rotation(linear);
    // The trace of the symmetric polar factor is the sum of the singular values.
    double trace = 0;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) trace += rotation.m[i][j] * linear.m[i][j];
    const Quaternion turn = quaternion_of(rotation);
    for (int k = 0; k < 3; ++k) instance.position[k] = matrix[4 * k + 3];
    std::copy(turn.begin(), turn.end(), instance.quaternion);
    instance.scale = trace / 3 * largest;
}

}  // namespace v3dg

// Computes the matrix that rotates an SH band. A rotation maps a band to itself, so its
// matrix follows from the values of the bases in enough directions. The colour in
// direction d of the new frame equals the colour of the old frame in direction d,
// rotated back.

#include "gather/sh_rotation.h"

#include <array>
#include <cmath>

#include "math/sh.h"

namespace v3dg {

namespace {

constexpr int kMaxBand = 7;
// Number of directions. The largest band needs 7; many more make the equations
// well-conditioned.
constexpr int kNumDirections = 32;

struct Direction {
    double x, y, z;
};

// Returns a point of a spiral from pole to pole.
Direction direction_of(int i) {
    const double z = 1 - (2 * i + 1) / static_cast<double>(kNumDirections);
    const double turn = i * 3.14159265358979323846 * (3 - std::sqrt(5.0)),
                 radius = std::sqrt(1 - z * z);
    return {radius * std::cos(turn), radius * std::sin(turn), z};
}

// Solves least-squares problems over the directions. For a right-hand side b[i], with
// one element per direction i, element r of the solution is the sum of weight[r][i] *
// b[i].
class Band {
  public:
    explicit Band(int degree) : degree_(degree), size_(2 * degree + 1) {
        double rows[kNumDirections][kMaxShBases];
        double system[kMaxBand][kMaxBand + kNumDirections] = {};
        for (int i = 0; i < kNumDirections; ++i) {
            const Direction d = direction_of(i);
            sh_bases(degree, d.x, d.y, d.z, rows[i]);
        }
        const int first = degree * degree;
        for (int r = 0; r < size_; ++r) {
            for (int c = 0; c < size_; ++c)
                for (const auto& row : rows) system[r][c] += row[first + r] * row[first + c];
            for (int i = 0; i < kNumDirections; ++i) system[r][size_ + i] = rows[i][first + r];
        }
        // The normal equations are nearly diagonal, so elimination needs no pivoting.
        for (int r = 0; r < size_; ++r) {
            const double pivot = system[r][r];
            for (int c = 0; c < size_ + kNumDirections; ++c) system[r][c] /= pivot;
            for (int other = 0; other < size_; ++other) {
                const double factor = system[other][r];
                if (other == r) continue;
                for (int c = 0; c < size_ + kNumDirections; ++c)
                    system[other][c] -= factor * system[r][c];
            }
        }
        for (int r = 0; r < size_; ++r)
            for (int i = 0; i < kNumDirections; ++i) weight_[r][i] = system[r][size_ + i];
    }

    void rotate(const double rotation[9], double* matrix) const {
        const int first = degree_ * degree_;
        for (int k = 0; k < size_ * size_; ++k) matrix[k] = 0;
        for (int i = 0; i < kNumDirections; ++i) {
            const Direction d = direction_of(i);
            double back[3], basis[kMaxShBases];
            for (int a = 0; a < 3; ++a)
                back[a] = rotation[a] * d.x + rotation[3 + a] * d.y + rotation[6 + a] * d.z;
            sh_bases(degree_, back[0], back[1], back[2], basis);
            for (int r = 0; r < size_; ++r)
                for (int c = 0; c < size_; ++c)
                    matrix[size_ * r + c] += weight_[r][i] * basis[first + c];
        }
    }

  private:
    int degree_, size_;
    double weight_[kMaxBand][kNumDirections];
};

}  // namespace

void rotate_sh_bands(const double rotation[9], int degree, double bands[kBandsSize]) {
    static const std::array<Band, 3> all{Band(1), Band(2), Band(3)};
    static constexpr int kFirst[3] = {0, 9, 9 + 25};
    for (int band = 1; band <= degree; ++band)
        all[band - 1].rotate(rotation, bands + kFirst[band - 1]);
}

}  // namespace v3dg

#include <numeric>
#include <vector>

#include "base/parallel_for.h"
#include "fit_group/ssim.h"

namespace v3dg {

namespace {

constexpr size_t kRowsAtOnce = 4;

size_t mirrored(size_t place, int offset, size_t size) {
    const auto shifted = static_cast<ptrdiff_t>(place) + offset,
               end = static_cast<ptrdiff_t>(size) - 1;
    return static_cast<size_t>(shifted < 0 ? -shifted
                                           : (shifted > end ? 2 * end - shifted : shifted));
}

void add(SsimSums<double>& to, double weight, const SsimSums<double>& s) {
    to.x += weight * s.x;
    to.y += weight * s.y;
    to.xx += weight * s.xx;
    to.yy += weight * s.yy;
    to.xy += weight * s.xy;
}

template <class T>
double sum_of_row(const SsimInput<T>& in, size_t row) {
    const size_t row_size = in.width * in.channels;
    // Sums over the rows of the window, one per column of the picture.
    std::vector<SsimSums<double>> columns(row_size);
    for (int k = -kSsimRadius; k <= kSsimRadius; ++k) {
        const size_t first = mirrored(row, k, in.height) * row_size;
        for (size_t i = 0; i < row_size; ++i) {
            const double x = in.picture[first + i], y = in.target[first + i];
            add(columns[i], ssim_weight<double>(k),
                {.x = x, .y = y, .xx = x * x, .yy = y * y, .xy = x * y});
        }
    }
    double sum = 0;
    for (size_t i = 0; i < row_size; ++i) {
        const size_t column = i / in.channels, channel = i % in.channels;
        SsimSums<double> sums{};
        for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
            add(sums, ssim_weight<double>(k),
                columns[mirrored(column, k, in.width) * in.channels + channel]);
        sum += ssim_of(sums).value;
    }
    return sum;
}

}  // namespace

template <class T>
double mean_ssim(const SsimInput<T>& in) {
    std::vector<double> sums(in.height);
    parallel_for(in.height, kRowsAtOnce, [&](size_t row) { sums[row] = sum_of_row(in, row); });
    return std::accumulate(sums.begin(), sums.end(), 0.0) /
           static_cast<double>(in.height * in.width * in.channels);
}

template double mean_ssim(const SsimInput<float>&);
template double mean_ssim(const SsimInput<double>&);

}  // namespace v3dg

#include "math/ssim.h"

#include "fit_group/dssim.h"

namespace v3dg {

// Applies the window in two passes, which is possible because it is separable. The
// operation is its own transpose, because the window is symmetric and pixels beyond the
// border are zero.
static void blur(const float* in, int width, int height, float* rows, float* out) {
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            float sum = 0;
            for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
                if (x + k >= 0 && x + k < width)
                    sum += ssim_weight<float>(k) * in[y * width + x + k];
            rows[y * width + x] = sum;
        }
    for (int y = 0; y < height; ++y) {
        float* line = out + y * width;
        for (int x = 0; x < width; ++x) line[x] = 0;
        for (int k = -kSsimRadius; k <= kSsimRadius; ++k) {
            if (y + k < 0 || y + k >= height) continue;
            const float w = ssim_weight<float>(k);
            for (int x = 0; x < width; ++x) line[x] += w * rows[(y + k) * width + x];
        }
    }
}

float dssim(const float* picture, const float* target, int width, int height, float weight,
            float* d_picture, SsimScratch& scratch) {
    const int n = width * height;
    scratch.maps.resize(10 * static_cast<size_t>(n));
    float* const m = scratch.maps.data();
    float *rows = m, *product = m + n, *mx = m + 2 * n, *my = m + 3 * n, *xx = m + 4 * n,
          *yy = m + 5 * n, *xy = m + 6 * n, *d_mx = m + 7 * n, *d_xx = m + 8 * n, *d_xy = m + 9 * n;
    blur(picture, width, height, rows, mx);
    blur(target, width, height, rows, my);
    for (int i = 0; i < n; ++i) product[i] = picture[i] * picture[i];
    blur(product, width, height, rows, xx);
    for (int i = 0; i < n; ++i) product[i] = target[i] * target[i];
    blur(product, width, height, rows, yy);
    for (int i = 0; i < n; ++i) product[i] = picture[i] * target[i];
    blur(product, width, height, rows, xy);
    double sum = 0;
    const float scale = -weight / static_cast<float>(n);
    for (int i = 0; i < n; ++i) {
        const auto ssim =
            ssim_of<float>({.x = mx[i], .y = my[i], .xx = xx[i], .yy = yy[i], .xy = xy[i]});
        sum += 1 - ssim.value;
        d_mx[i] = scale * ssim.d_x;
        d_xx[i] = scale * ssim.d_xx;
        d_xy[i] = scale * ssim.d_xy;
    }
    float* spread = xx;
    blur(d_mx, width, height, rows, spread);
    for (int i = 0; i < n; ++i) d_picture[i] += spread[i];
    blur(d_xx, width, height, rows, spread);
    for (int i = 0; i < n; ++i) d_picture[i] += 2 * picture[i] * spread[i];
    blur(d_xy, width, height, rows, spread);
    for (int i = 0; i < n; ++i) d_picture[i] += target[i] * spread[i];
    return static_cast<float>(sum / n);
}

}  // namespace v3dg

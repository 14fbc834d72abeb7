#include <cmath>

#include "loss/loss.h"

namespace v3dg {

constexpr int kRadius = 5;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
    float weight[2 * kRadius + 1];
    Window() {
        double sum = 0, w[2 * kRadius + 1];
        for (int i = -kRadius; i <= kRadius; ++i) sum += w[i + kRadius] = std::exp(-i * i / (2 * 1.5 * 1.5));
        for (int i = 0; i <= 2 * kRadius; ++i) weight[i] = static_cast<float>(w[i] / sum);
    }
};

// Both passes of the separable window; its own transpose, since it is symmetric and zeros lie outside.
static void blur(const float* in, int width, int height, float* rows, float* out) {
    static const Window window;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            float sum = 0;
            for (int k = -kRadius; k <= kRadius; ++k)
                if (x + k >= 0 && x + k < width) sum += window.weight[k + kRadius] * in[y * width + x + k];
            rows[y * width + x] = sum;
        }
    for (int y = 0; y < height; ++y) {
        float* line = out + y * width;
        for (int x = 0; x < width; ++x) line[x] = 0;
        for (int k = -kRadius; k <= kRadius; ++k) {
            if (y + k < 0 || y + k >= height) continue;
            const float w = window.weight[k + kRadius];
            for (int x = 0; x < width; ++x) line[x] += w * rows[(y + k) * width + x];
        }
    }
}

float dssim(const float* picture, const float* target, int width, int height, float weight, float* d_picture,
            SsimScratch& scratch) {
    const int n = width * height;
    scratch.maps.resize(10 * static_cast<size_t>(n));
    float* const m = scratch.maps.data();
    float *rows = m, *product = m + n, *mx = m + 2 * n, *my = m + 3 * n, *xx = m + 4 * n, *yy = m + 5 * n,
          *xy = m + 6 * n, *d_mx = m + 7 * n, *d_xx = m + 8 * n, *d_xy = m + 9 * n;
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
        const float a1 = 2 * mx[i] * my[i] + kC1, a2 = 2 * (xy[i] - mx[i] * my[i]) + kC2;
        const float b1 = mx[i] * mx[i] + my[i] * my[i] + kC1;
        const float b2 = xx[i] - mx[i] * mx[i] + yy[i] - my[i] * my[i] + kC2;
        const float ssim = a1 * a2 / (b1 * b2);
        sum += 1 - ssim;
        d_mx[i] = scale * (2 * my[i] * (a2 - a1) / (b1 * b2) - 2 * mx[i] * ssim * (1 / b1 - 1 / b2));
        d_xx[i] = -scale * ssim / b2;
        d_xy[i] = scale * 2 * a1 / (b1 * b2);
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

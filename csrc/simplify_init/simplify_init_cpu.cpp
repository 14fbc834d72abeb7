#include "simplify_init/simplify_init.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "base/parallel_for.h"
#include "cluster/cluster.h"
#include "math/sh.h"
#include "simplify_init/simplify_init_math.h"

namespace v3dg {

void cpu::prune(const RowsIn& in, Span<const int64_t> in_offset, Span<const int64_t> out_offset,
                Span<int64_t> kept) {
    const size_t num_groups = in_offset.size - 1, count = in_offset[num_groups];
    std::vector<int64_t> order(count), cell(num_groups * kPruneCells + 1);
    median_split({reinterpret_cast<const Point*>(in.means), count}, in_offset, kPruneHalvings,
                 {order.data(), count}, {cell.data(), cell.size()});
    std::vector<double> score(count);
    parallel_for(count, 4096, [&](size_t i) { score[i] = prune_score(in.scales + 3 * i, in.opacities[i]); });
    parallel_for(num_groups, 1, [&](size_t g) {
        const CellShares shares{in_offset[g], in_offset[g + 1], out_offset[g + 1] - out_offset[g]};
        int64_t* out = kept.data + out_offset[g];
        for (size_t c = g * kPruneCells; c < (g + 1) * kPruneCells; ++c) {
            const int64_t share = shares.of(cell[c], cell[c + 1]);
            std::sort(order.begin() + cell[c], order.begin() + cell[c + 1], [&](int64_t a, int64_t b) {
                return score[a] != score[b] ? score[a] > score[b] : a < b;
            });
            out = std::copy_n(order.begin() + cell[c], share, out);
        }
        std::sort(kept.data + out_offset[g], out);
    });
}

namespace {

// A gaussian while it is being merged, with what the cost needs.
struct Node {
    double mean[3], cov[6], color[3];
    double area, opacity, weight;  // weight = area * opacity
    int64_t order;                 // lowest row it holds
    std::vector<int64_t> rows;
};

// What a pair loses: the variance that joining adds, in place (over the area that each gaussian that is left
// stands for) and in colour. Ward's criterion, weighted by what the gaussians cover.
double merge_cost(const Node& a, const Node& b, double inverse_spacing2) {
    constexpr double kColorWeight = 6;
    double place = 0, color = 0;
    for (int k = 0; k < 3; ++k) {
        place += (a.mean[k] - b.mean[k]) * (a.mean[k] - b.mean[k]);
        color += (a.color[k] - b.color[k]) * (a.color[k] - b.color[k]);
    }
    return a.weight * b.weight / (a.weight + b.weight) * (place * inverse_spacing2 + kColorWeight * color);
}

void join(Node& a, const Node& b) {
    const double w = a.weight + b.weight, share = b.weight / w;
    double d[3];
    for (int k = 0; k < 3; ++k) d[k] = b.mean[k] - a.mean[k];
    int at = 0;
    for (int i = 0; i < 3; ++i)
        for (int k = i; k < 3; ++k, ++at)
            a.cov[at] += share * (b.cov[at] - a.cov[at]) + share * (1 - share) * d[i] * d[k];
    for (int k = 0; k < 3; ++k) {
        a.mean[k] += share * d[k];
        a.color[k] += share * (b.color[k] - a.color[k]);
    }
    double scale[3], quat[4];
    scale_and_quat_of(a.cov, scale, quat);
    a.area = ellipsoid_area(scale[0], scale[1], scale[2]);
    a.weight = w;
    a.opacity = a.area > 0 ? std::min(1.0, w / a.area) : 1.0;
    a.order = std::min(a.order, b.order);
    a.rows.insert(a.rows.end(), b.rows.begin(), b.rows.end());
}

void copy_row(const RowsIn& in, int64_t from, const RowsOut& out, int64_t to) {
    std::copy_n(in.means + 3 * from, 3, out.means + 3 * to);
    std::copy_n(in.quats + 4 * from, 4, out.quats + 4 * to);
    std::copy_n(in.scales + 3 * from, 3, out.scales + 3 * to);
    out.opacities[to] = in.opacities[from];
    std::copy_n(in.sh + in.num_sh * from, in.num_sh, out.sh + in.num_sh * to);
}

struct Pair {
    double cost;
    int a, b;
};

}  // namespace

void cpu::merge(const RowsIn& in, Span<const int64_t> in_offset, Span<const int64_t> out_offset,
                const RowsOut& out) {
    parallel_for(in_offset.size - 1, 1, [&](size_t g) {
        const int64_t first = in_offset[g], count = in_offset[g + 1] - first;
        const int64_t wanted = out_offset[g + 1] - out_offset[g];
        if (count == 0) return;
        std::vector<Node> nodes(count);
        std::vector<double> row_weight(count);
        double low[3] = {1e300, 1e300, 1e300}, high[3] = {-1e300, -1e300, -1e300};
        for (int64_t i = 0; i < count; ++i) {
            Node& n = nodes[i];
            const int64_t r = first + i;
            double scale[3], quat[4];
            for (int k = 0; k < 3; ++k) {
                n.mean[k] = in.means[3 * r + k];
                scale[k] = in.scales[3 * r + k];
                n.color[k] = kShBase0 * in.sh[in.num_sh * r + k];
                low[k] = std::min(low[k], n.mean[k]);
                high[k] = std::max(high[k], n.mean[k]);
            }
            for (int k = 0; k < 4; ++k) quat[k] = in.quats[4 * r + k];
            covariance_of(quat, scale, n.cov);
            n.area = ellipsoid_area(scale[0], scale[1], scale[2]);
            n.opacity = in.opacities[r];
            n.weight = std::max(n.area * n.opacity, 1e-300);
            n.order = i;
            n.rows = {i};
            row_weight[i] = n.weight;
        }
        const double extent2 = (high[0] - low[0]) * (high[0] - low[0]) +
                               (high[1] - low[1]) * (high[1] - low[1]) +
                               (high[2] - low[2]) * (high[2] - low[2]);
        const double inverse_spacing2 = extent2 > 0 ? static_cast<double>(wanted) / extent2 : 0;

        // Rounds: each node finds its cheapest partner, and the cheapest disjoint pairs join; at most half of
        // what is still to go, so that what was joined can be weighed again.
        std::vector<Pair> pairs;
        while (static_cast<int64_t>(nodes.size()) > wanted) {
            const int n = static_cast<int>(nodes.size());
            pairs.clear();
            for (int i = 0; i < n; ++i) {
                Pair best{1e300, -1, -1};
                for (int k = 0; k < n; ++k) {
                    if (k == i) continue;
                    const double cost = merge_cost(nodes[i], nodes[k], inverse_spacing2);
                    if (cost < best.cost) best = {cost, std::min(i, k), std::max(i, k)};
                }
                if (best.a >= 0) pairs.push_back(best);
            }
            std::sort(pairs.begin(), pairs.end(), [](const Pair& x, const Pair& y) {
                return x.cost != y.cost ? x.cost < y.cost : (x.a != y.a ? x.a < y.a : x.b < y.b);
            });
            int64_t to_go = n - wanted, allowed = std::max<int64_t>(1, (to_go + 1) / 2);
            std::vector<char> used(n, 0);
            for (const Pair& p : pairs) {
                if (allowed == 0) break;
                if (used[p.a] || used[p.b]) continue;
                used[p.a] = 1;
                used[p.b] = 2;
                join(nodes[p.a], nodes[p.b]);
                --allowed;
            }
            int kept = 0;
            for (int i = 0; i < n; ++i)
                if (used[i] != 2) {
                    if (kept != i) nodes[kept] = std::move(nodes[i]);
                    ++kept;
                }
            nodes.resize(kept);
        }
        std::sort(nodes.begin(), nodes.end(), [](const Node& a, const Node& b) { return a.order < b.order; });
        for (size_t i = 0; i < nodes.size(); ++i) {
            const Node& n = nodes[i];
            const int64_t to = out_offset[g] + int64_t(i);
            if (n.rows.size() == 1) {
                copy_row(in, first + n.rows[0], out, to);
                continue;
            }
            double scale[3], quat[4];
            scale_and_quat_of(n.cov, scale, quat);
            for (int k = 0; k < 3; ++k) out.means[3 * to + k] = static_cast<float>(n.mean[k]);
            for (int k = 0; k < 4; ++k) out.quats[4 * to + k] = static_cast<float>(quat[k]);
            for (int k = 0; k < 3; ++k) out.scales[3 * to + k] = static_cast<float>(scale[k]);
            out.opacities[to] = static_cast<float>(n.opacity);
            for (int k = 0; k < in.num_sh; ++k) {
                double sum = 0;
                for (const int64_t r : n.rows) sum += row_weight[r] * in.sh[in.num_sh * (first + r) + k];
                out.sh[in.num_sh * to + k] = static_cast<float>(sum / n.weight);
            }
        }
    });
}

}  // namespace v3dg

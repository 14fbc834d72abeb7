// Pruning and merging on the CPU. Each thread processes one group at a time.

#include "simplify/simplify.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "base/parallel_for.h"
#include "simplify/simplify_math.h"

namespace v3dg {

namespace {

// Computes the median of rows `first` to `last` along each axis.
void find_medians(const float* means, int64_t first, int64_t last, std::vector<float>& scratch,
                  float median[3]) {
    const int64_t count = last - first;
    scratch.resize(count);
    for (int axis = 0; axis < 3; ++axis) {
        for (int64_t i = 0; i < count; ++i) scratch[i] = means[3 * (first + i) + axis];
        const auto middle = scratch.begin() + median_rank(count);
        std::nth_element(scratch.begin(), middle, scratch.end());
        median[axis] = *middle;
    }
}

// Chooses the rows that a group keeps, in ascending order. The group has the rows
// `first` to `last`.
void prune_group(const GaussianRows<const float>& in, int64_t first, int64_t last, int64_t wanted,
                 int64_t* out) {
    const int64_t count = last - first;
    if (count == 0) return;
    std::vector<float> coordinates;
    float median[3];
    find_medians(in.means, first, last, coordinates, median);
    std::vector<int64_t> octants[kOctants];
    std::vector<double> score(count);
    for (int64_t row = first; row < last; ++row) {
        octants[octant_of(in.means + 3 * row, median)].push_back(row);
        score[row - first] = prune_score(in.scales + 3 * row, in.opacities[row]);
    }
    const auto is_more_important = [&](int64_t a, int64_t b) {
        const double score_a = score[a - first];
        const double score_b = score[b - first];
        return score_a != score_b ? score_a > score_b : a < b;
    };
    int64_t* const begin = out;
    int64_t num_before = 0;
    for (std::vector<int64_t>& rows : octants) {
        const auto num_here = static_cast<int64_t>(rows.size());
        const int64_t share = octant_share(num_before, num_here, count, wanted);
        std::sort(rows.begin(), rows.end(), is_more_important);
        out = std::copy_n(rows.begin(), share, out);
        num_before += num_here;
    }
    std::sort(begin, out);
}

}  // namespace

void cpu::prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
                Span<const int64_t> out_offset, Span<int64_t> kept) {
    const size_t num_groups = in_offset.size - 1;
    parallel_for(num_groups, 1, [&](size_t g) {
        const int64_t wanted = out_offset[g + 1] - out_offset[g];
        prune_group(in, in_offset[g], in_offset[g + 1], wanted, kept.data + out_offset[g]);
    });
}

namespace {

// Merges `count` rows, beginning with row `first`, to `wanted` rows. Writes the result
// to the rows from `to` on.
void merge_segment(const GaussianRows<const float>& in, int64_t first, int count, int64_t wanted,
                   const GaussianRows<float>& out, int64_t to) {
    // A node stores the index of its first row. Its other rows follow in a linked list.
    std::vector<MergeNode> nodes(count);
    std::vector<double> row_weight(count);
    std::vector<int> alive(count), next(count, -1), last(count);
    double low[3], high[3];
    for (int i = 0; i < count; ++i) {
        nodes[i] = merge_node_of(in, first + i);
        row_weight[i] = nodes[i].feature.weight;
        alive[i] = last[i] = i;
        for (int k = 0; k < 3; ++k) {
            const double x = nodes[i].feature.mean[k];
            low[k] = i == 0 ? x : std::min(low[k], x);
            high[k] = i == 0 ? x : std::max(high[k], x);
        }
    }
    const double inverse_spacing2 = inverse_spacing2_of(low, high, wanted);

    // In each round, every node finds its cheapest partner. Then the cheapest disjoint
    // pairs are joined.
    std::vector<MergeFeature> features(count);
    std::vector<MergePair> pairs;
    std::vector<char> is_used;
    while (static_cast<int64_t>(alive.size()) > wanted) {
        const int n = static_cast<int>(alive.size());
        for (int i = 0; i < n; ++i) features[i] = nodes[alive[i]].feature;
        pairs.clear();
        for (int i = 0; i < n; ++i) {
            double cheapest = INFINITY;
            int partner = i == 0 ? 1 : 0;
            for (int k = 0; k < n; ++k) {
                if (k == i) continue;
                const double cost = merge_cost(features[i], features[k], inverse_spacing2);
                if (cost < cheapest) {
                    cheapest = cost;
                    partner = k;
                }
            }
            pairs.push_back({cheapest, std::min(i, partner), std::max(i, partner)});
        }
        std::sort(pairs.begin(), pairs.end(), is_before);
        int64_t allowed = pairs_in_round(n, wanted);
        is_used.assign(n, 0);
        std::vector<int> kept = alive;
        for (const MergePair& pair : pairs) {
            if (allowed == 0) break;
            if (is_used[pair.a] || is_used[pair.b]) continue;
            is_used[pair.a] = is_used[pair.b] = 1;
            const int a = alive[pair.a], b = alive[pair.b];
            join(nodes[a], nodes[b]);
            next[last[a]] = b;
            last[a] = last[b];
            kept[pair.b] = -1;
            --allowed;
        }
        kept.erase(std::remove(kept.begin(), kept.end(), -1), kept.end());
        alive.swap(kept);
    }
    for (const int i : alive) {
        if (next[i] < 0) {
            copy_shape(in, first + i, out, to);
            std::copy_n(in.sh + in.num_sh() * (first + i), in.num_sh(), out.sh + in.num_sh() * to);
        } else {
            write_joined(nodes[i], out, to);
            for (int k = 0; k < in.num_sh(); ++k) {
                double sum = 0;
                for (int row = i; row >= 0; row = next[row])
                    sum += row_weight[row] * in.sh[in.num_sh() * (first + row) + k];
                out.sh[in.num_sh() * to + k] = static_cast<float>(sum / nodes[i].feature.weight);
            }
        }
        ++to;
    }
}

}  // namespace

void cpu::merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
                Span<const int64_t> out_offset, const GaussianRows<float>& out) {
    parallel_for(in_offset.size - 1, 1, [&](size_t g) {
        merge_segment(in, in_offset[g], static_cast<int>(in_offset[g + 1] - in_offset[g]),
                      out_offset[g + 1] - out_offset[g], out, out_offset[g]);
    });
}

}  // namespace v3dg

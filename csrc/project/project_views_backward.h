#pragma once

// The backward pass of projection on CUDA for several pictures of the same gaussians.
// It sums the gradients over the pictures.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// The records of several pictures ("views") of N gaussians. The gaussians of an item
// are the kItemSize gaussians from i * kItemSize on; view v has the items from v *
// num_items on. The records of item k begin at k * kItemSize, in the order of the
// gaussians.
struct ProjectViewsInput {
    const uint32_t* item_records;  // number of records of each item
    RecordPlanes records;
    const uint32_t* source;  // index of each record's gaussian
    // The gaussians of all views, or of each view.
    const GaussianRows<const float>* models;
    bool has_model_for_each_view;
    uint64_t num_gaussians;
    int sh_degree;
    const Placement* placements;  // of each view
    const FrameImage* images;     // of each view; pinholes
    uint32_t num_views;
    float filter_px2;
    bool antialiased;
};

// The gradients of views. Rows are sums over views, in the order of the views. They are
// (N, ...), or (views, N, ...) for opacities and SH coefficients that each view has for
// itself.
struct ViewsGradients {
    GaussianRows<float> rows;
    bool has_opacities_for_each_view, has_sh_for_each_view;
    CenterGradients<float> centers;  // (views, N, 2)
    float* poses;                    // (views, 3, 4) of [R t]; may be null

    // Returns the gradients of the views from `view` on.
    ViewsGradients from(size_t view) const;
};

// Writes the gradients of every gaussian. If `adds`, the sums over views begin with the
// values that `out` has.
void project_views_backward(const ProjectViewsInput& in, const GradientSlots& slots,
                            const ViewsGradients& out, bool adds, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg

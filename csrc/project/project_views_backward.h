#pragma once

// The backward pass of projection on CUDA for several pictures of the same gaussians.
// It sums the gradients over the pictures.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// The records of several pictures ("views") of N gaussians. The gaussians of an item
// are the kItemSize gaussians that begin at i * kItemSize; the items of view v begin at
// v * num_items. The records of item k begin at k * kItemSize, in the order of the
// gaussians.
struct ProjectViewsInput {
    const uint32_t* item_records;  // number of records of each item
    RecordPlanes records;
    const uint32_t* source;  // index of each record's gaussian
    // One element for all views, or one for each view.
    const GaussianRows<const float>* models;
    bool has_model_for_each_view;
    uint64_t num_gaussians;
    int sh_degree;
    const Placement* placements;  // one per view
    const FrameImage* images;     // one per view; all cameras are pinhole cameras
    uint32_t num_views;
    float filter_px2;
    bool antialiased;
};

// The gradients of views. Rows are sums over views, added in the order of the views.
// They are (N, ...). Opacities and SH coefficients that differ between views are
// (views, N, ...) instead.
struct ViewsGradients {
    GaussianRows<float> rows;
    bool has_opacities_for_each_view, has_sh_for_each_view;
    CenterGradients<float> centers;  // (views, N, 2)
    float* poses;                    // (views, 3, 4) gradients of [R t]; may be null

    // Returns the gradients of the views from `view` on.
    ViewsGradients from(size_t view) const;
};

// Writes the gradients of every gaussian. If `adds` is true, the sums over views start
// from the values in `out`.
void project_views_backward(const ProjectViewsInput& in, const GradientSlots& slots,
                            const ViewsGradients& out, bool adds, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg

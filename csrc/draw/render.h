#pragma once

#include <atomic>
#include <vector>

#include "base/buffer.h"
#include "frame/draw_list.h"
#include "frame/image.h"
#include "frame/record.h"
#include "tile_bin/tile_bin.h"

namespace v3dg {

// The temporary memory of one picture, reused from picture to picture.
template <class T>
struct Workspace {
    // The records of a chunk are adjacent, in the order of the draws. Chunks are in any
    // order, with gaps between them.
    Buffer<Record<T>> records;
    Buffer<uint32_t> source;
    Buffer<uint64_t> chunk_first;
    Buffer<uint32_t> chunk_count;
    TileLists lists;
    size_t num_chunks = 0;
    uint64_t room = 0;       // length of the records, including gaps
    uint64_t most_room = 0;  // largest `room` so far, of which pages may be in physical memory
};

struct RenderCounts {
    uint64_t in_frustum;  // gaussians whose extent meets the image
    uint64_t records;     // gaussians that reach a pixel centre
    uint64_t entries;     // records in the lists of the window's tiles
    double project_seconds, bin_seconds, rasterize_seconds;
};

// Draws the picture's window of everything in `draws`: project, bin, sort, blend.
// Gaussians of equal depth are blended in the order of the draws. A picture that
// exceeds the memory limit is drawn in bands of tile rows, with the same result. With
// `keep_source`, it is drawn in one band and the workspace can be passed to
// render_backward(); `source` is then the index of each record's gaussian, counted
// through all draws. Throws std::length_error above about 3e9 gaussians. Once `stop` is
// true, it returns soon and leaves the picture and the counts unfinished.
template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Intrinsics<T>& camera,
                    const Picture<T>& picture, bool keep_source, Workspace<T>& workspace,
                    const std::atomic<bool>* stop = nullptr);

// The gaussian with the largest weight in a pixel.
struct Pick {
    uint64_t gaussian;  // index, counted through all draws
    float weight;       // its blend weight
    float depth;
};

// Finds the gaussian with the largest weight. Returns whether there is any.
bool pick(const std::vector<Draw<float>>& draws, const Intrinsics<float>& camera, int x, int y,
          Pick& picked);

// Computes the gradients of a single draw's gaussians from the gradients of the picture
// that `workspace` was used for. It does not accumulate: `out` and `centers` are
// overwritten for gaussians with a record and unchanged for others.
template <class T>
void render_backward(const Draw<T>& draw, const Intrinsics<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& workspace,
                     const GaussianRows<T>& out, const CenterGradients<T>& centers,
                     T d_background[3]);

}  // namespace v3dg

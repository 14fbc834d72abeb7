// Draws pictures of one model, with a backward pass. Idle frames are kept for reuse.

#include "draw/render_backward_cuda.h"

#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "rasterize/rasterize.h"

namespace v3dg {
namespace cuda {

DifferentiableFrame::DifferentiableFrame() : frame_(Frame::Keeps::tape) {
    check(cudaGetDevice(&device_), "cudaGetDevice");
    for (cudaEvent_t* event : {&drawn_, &gone_back_})
        check(cudaEventCreateWithFlags(event, cudaEventDisableTiming), "cudaEventCreate");
}

DifferentiableFrame::~DifferentiableFrame() {
    for (const cudaEvent_t event : {drawn_, gone_back_})
        if (event != nullptr) cudaEventDestroy(event);
    // Ignore errors, because at exit the driver may be unloaded before this object is
    // destroyed.
    cudaGetLastError();
}

void DifferentiableFrame::draw(const ModelPicture& in, cudaStream_t stream) {
    in_ = in;
    check(cudaStreamWaitEvent(stream, gone_back_, 0), "cudaStreamWaitEvent");
    const std::unique_ptr<Drawing> drawing =
        frame_.draw(in.rows, in.view, in.filter_px2, in.antialiased, in.image, stream);
    num_slots_ = drawing->settle().slots;
    if (num_slots_ > UINT32_MAX)
        throw std::length_error("gaussians: expected at most 4294967295 gradient slots, got " +
                                std::to_string(num_slots_));
    check(cudaEventRecord(drawn_, stream), "cudaEventRecord");
}

void DifferentiableFrame::backward(const PictureGradient<float>& d_picture,
                                   const GaussianRows<float>& out,
                                   const CenterGradients<float>& centers, float* d_background,
                                   cudaStream_t stream) {
    check(cudaStreamWaitEvent(stream, drawn_, 0), "cudaStreamWaitEvent");
    const FrameTape tape = frame_.tape();
    const DeviceBuffer<RecordGradient<float>> slot(num_slots_, stream);
    const DeviceBuffer<CenterSize<float>> size(centers.size != nullptr ? num_slots_ : 0, stream);
    const DeviceBuffer<uint8_t> is_touched(num_slots_, stream);
    const DeviceBuffer<float> d_background_of_tile(3 * size_t(tape.lists.num_tiles), stream);
    if (num_slots_ > 0)
        check(cudaMemsetAsync(is_touched.data(), 0, num_slots_, stream), "cudaMemsetAsync");
    const GradientSlots slots{tape.first_slot, slot.data(), size.data(), is_touched.data()};
    rasterize_backward({in_.image, tape.lists.records, tape.lists.tile_first, tape.raster.order,
                        tape.raster.blended, tape.lists.plans, d_picture},
                       slots, d_background_of_tile.data(), d_background, stream);
    project_backward({.item_records = tape.item_records,
                      .records = tape.lists.records,
                      .source = tape.source,
                      .rows = in_.rows,
                      .view = in_.view,
                      .camera = in_.image.camera,
                      .filter_px2 = in_.filter_px2,
                      .antialiased = in_.antialiased,
                      .has_lenses = !in_.image.camera.is_pinhole()},
                     slots, out, centers, stream);
    check(cudaEventRecord(gone_back_, stream), "cudaEventRecord");
}

namespace {

struct IdleFrames {
    std::mutex mutex;
    std::map<int, std::vector<std::unique_ptr<DifferentiableFrame>>> of_device;
};

IdleFrames& idle_frames() {
    // This object is never destroyed, because at exit the driver may be unloaded before
    // static objects are destroyed.
    static IdleFrames& frames = *new IdleFrames;
    return frames;
}

}  // namespace

std::unique_ptr<DifferentiableFrame> take_frame() {
    int device;
    check(cudaGetDevice(&device), "cudaGetDevice");
    IdleFrames& idle = idle_frames();
    const std::lock_guard<std::mutex> lock(idle.mutex);
    auto& frames = idle.of_device[device];
    if (frames.empty()) return std::make_unique<DifferentiableFrame>();
    auto frame = std::move(frames.back());
    frames.pop_back();
    return frame;
}

void give_back(std::unique_ptr<DifferentiableFrame> frame) {
    IdleFrames& idle = idle_frames();
    const std::lock_guard<std::mutex> lock(idle.mutex);
    idle.of_device[frame->device_].push_back(std::move(frame));
}

}  // namespace cuda
}  // namespace v3dg

#pragma once

// What a pool of pages decides: which pages are read, which become resident, which make room, and
// in what order. It knows no threads and no bytes: whoever asks is one thread at a time, and tells
// what was read.
//
// Memory is rows of gaussians, and places of clusters: those of the coarsest pages of all bundles
// first, which stay, then slots that hold any other page. What is resident is closed towards the
// root at every moment: a page comes after the page above it, and goes when none below it is there.

#include <atomic>
#include <cstdint>
#include <memory>
#include <vector>

#include "base/buffer.h"
#include "residency/cluster_table.h"
#include "residency/page_source.h"

namespace v3dg {

// A bundle of which pages are resident: its tables, of which only those of groups and clusters are
// read and only at the start, and where its pages come from.
struct PagedBundle {
    ClusterTable table;
    std::shared_ptr<const PageSource> source;
};

// Memory for gaussians.
struct PoolMemory {
    size_t num_bytes;
    size_t row_bytes, cluster_bytes;  // that a gaussian takes, and a cluster besides
    size_t most_rows = UINT32_MAX;    // that whoever draws can tell apart

    size_t bytes_of(size_t num_rows, size_t num_clusters) const {
        return num_rows * row_bytes + num_clusters * cluster_bytes;
    }
};

// What that is divided into: what the coarsest pages take, then slots of one size.
struct SlotPlan {
    size_t first_slot_row = 0, first_slot_cluster = 0;
    size_t num_slots = 0, slot_rows = 1, slot_clusters = 1;

    size_t num_rows() const { return first_slot_row + num_slots * slot_rows; }
    size_t num_clusters() const { return first_slot_cluster + num_slots * slot_clusters; }
    // What a page of so many clusters that begin there has of them: all in a slot, else its own.
    size_t num_clusters_at(size_t cluster, size_t num_clusters) const {
        return cluster < first_slot_cluster ? num_clusters : slot_clusters;
    }
    // [num_clusters() + 1] rows where clusters begin while there is nothing in any slot, ascending.
    std::vector<int64_t> empty_offsets() const;
};

// A page that comes to its slot, or leaves it.
struct PageChange {
    uint32_t bundle, page;
    int64_t row;                 // where its rows begin; kAbsentPage: it leaves
    size_t cluster;              // where the places of its clusters begin
    const unsigned char* bytes;  // of what comes
};

enum class PageState : uint8_t { absent, loading, loaded, resident, failed };

// A page that has been read and is not resident yet.
struct LoadedPage {
    uint32_t bundle, page;
    unsigned char* block;
    float priority = 0;  // of the last view that asked for it
};

// What becomes of pages that were loaded.
struct PagesComing {
    std::vector<PageChange> changes;      // in this order
    std::vector<unsigned char*> dropped;  // blocks of those that nobody wants any more
    size_t bytes = 0;                     // that come
    size_t num_left = 0;                  // that wait only for bytes of a later frame

    void clear();
};

class PagePolicy {
  public:
    // Throws std::invalid_argument where there is no room for the coarsest pages and one page more
    // of each bundle.
    PagePolicy(const std::vector<PagedBundle>& bundles, const PoolMemory& memory);

    size_t num_slots() const { return slots_.size(); }
    const SlotPlan& plan() const { return plan_; }
    // The coarsest page of a bundle, without its bytes.
    PageChange root(size_t bundle) const;
    size_t num_pages() const { return slot_of_page_.size; }
    size_t most_page_bytes() const { return most_page_bytes_; }
    const PageSource& source(size_t bundle) const { return *bundles_[bundle].source; }
    // The place of a page among those of all bundles, and that of the page above it; below 0: none
    // is.
    uint32_t id_of(size_t bundle, size_t page) const {
        return bundles_[bundle].first_page + static_cast<uint32_t>(page);
    }
    int32_t page_above(uint32_t id) const { return pages_[id].parent; }

    // Any thread may ask for the state of a page, and change it from absent to loading and from
    // that on.
    std::atomic<PageState>& state(size_t bundle, size_t page) const {
        return states_[id_of(bundle, page)];
    }
    void forget_failures();
    // Takes the memory for as many loaded pages, so that bring() never wants for it.
    void reserve(size_t num_loaded) { left_.reserve(num_loaded); }

    // Takes note of what the cut of a frame needed, absent or resident, in any order. So many more
    // pages are needed as are left out, which is more than there is room for. `has_failures`: some
    // pages cannot be had.
    void note(Span<const PageRequest> needs, size_t num_left_out, bool has_failures);
    // What is read next for that, the most urgent stretch last and each from its end, those above
    // before those below: no more than there will be room for, beside what is under way.
    void choose(size_t under_way, std::vector<PageRequest>& todo);
    // Of that frame: pages that it misses, and slots that it would take.
    size_t missing() const { return missing_; }
    size_t needed() const { return missing_ + num_needed_; }

    // Brings loaded pages to slots, the most urgent first, of about so many bytes; at least one.
    // What it leaves has to wait: for bytes, or for a page above that is under way.
    void bring(std::vector<LoadedPage>& loaded, size_t most_bytes, PagesComing& out);

  private:
    struct Bundle {
        std::shared_ptr<const PageSource> source;
        uint32_t first_page = 0;
        size_t root_row = 0, root_cluster = 0;
        size_t most_rows = 1, most_clusters = 1, most_bytes = 1;  // of its pages but the coarsest
    };
    struct Page {
        int32_t parent = -1;   // all pages are numbered together; -1: the coarsest has none
        uint32_t stamp = 0;    // view that asked for it last
        float priority = 0;    // then
        uint32_t stretch = 0;  // of that view, where it is wanted
    };
    struct Slot {
        int32_t bundle = -1;
        uint32_t page = 0;
    };
    // Of a slot: one more than the view that needed its page last, and that used it: needed it, or
    // nearly.
    struct Use {
        uint32_t last_needed = 0, last_used = 0;
        int32_t above = 0;          // slot of the page above; below 0: that is the coarsest
        uint32_t num_children = 0;  // that are resident
    };
    // Slots with a page that this view, or the one before and not this one, needed or used.
    struct Kept {
        size_t now = 0, before = 0;
    };
    struct Wanted {
        uint32_t bundle, page, key;  // key: of its urgency
    };
    // Of what is as urgent: places that are left, and where they end.
    struct Places {
        uint32_t count = 0, end = 0;
    };
    // A slot that may go, as long as its page was not used again.
    struct Leaving {
        uint32_t last_used, slot;

        bool operator<(const Leaving& other) const {
            return last_used != other.last_used ? last_used < other.last_used : slot < other.slot;
        }
        bool operator>(const Leaving& other) const { return other < *this; }
    };

    void add_pages(Bundle& bundle, const ClusterTable& table);
    void plan_memory(const PoolMemory& memory);
    PageState state_of(size_t id) const { return states_[id].load(std::memory_order_acquire); }
    void use(int32_t slot, bool is_needed);
    size_t ask(const PageRequest& request, bool has_failures);
    int32_t block_above(int32_t id) const;
    void find_stretches();
    void touch(uint32_t& last, uint32_t value, Kept& kept);
    // What this view and the one before did without.
    bool is_old(uint32_t last) const { return last < noted_; }
    size_t num_old(const Kept& kept) const { return slots_.size() - kept.now - kept.before; }
    bool may_go(uint32_t slot) const {
        return is_old(uses_[slot].last_needed) && uses_[slot].num_children == 0;
    }
    void find_leaving();
    bool has_leaving();
    bool make_room(bool is_missed, PagesComing& out);
    void evict(uint32_t slot, PagesComing& out);
    void occupy(const LoadedPage& loaded, PagesComing& out);

    std::vector<Bundle> bundles_;
    SlotPlan plan_;
    size_t most_page_bytes_ = 1;

    // Of pages. A page that is in no slot is absent, on its way, or the coarsest of its bundle.
    Buffer<int32_t> slot_storage_;
    Buffer<Page> page_storage_;
    Span<int32_t> slot_of_page_;
    Span<Page> pages_;
    std::unique_ptr<std::atomic<PageState>[]> states_;

    std::vector<Slot> slots_;
    std::vector<Use> uses_;
    std::vector<uint32_t> free_slots_;

    uint32_t noted_ = 1;  // views, and one more
    Kept needed_, used_;
    size_t missing_ = 0, num_needed_ = 0;
    std::vector<Wanted> wanted_;
    std::vector<uint32_t> key_of_stretch_;
    std::vector<Places> places_of_key_;
    // A heap, those first that were not used for longest. It lasts from frame to frame: what comes
    // to be old meanwhile is younger than what it has.
    std::vector<Leaving> leaving_;
    bool finds_none_ = false;  // that may go, until the next view is noted
    std::vector<LoadedPage> left_;
};

}  // namespace v3dg

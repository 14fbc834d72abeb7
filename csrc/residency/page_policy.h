#pragma once

// The decisions of a page pool: which pages are read, which become resident, which are
// evicted, and in what order. The policy knows neither threads nor bytes: one thread at
// a time calls it and reports which pages were read.
//
// The memory holds rows of gaussians and entries of clusters. First come those of the
// coarsest pages of all bundles, which are never evicted; then slots of one size, each
// of which fits any other page. At every moment the set of resident pages is closed
// towards the root: a page becomes resident after the page above it, and is evicted
// only when no page below it is resident.

#include <atomic>
#include <cstdint>
#include <memory>
#include <vector>

#include "base/buffer.h"
#include "residency/cluster_table.h"
#include "residency/page_source.h"

namespace v3dg {

// A partly resident bundle: its tables and the source of its pages. Only the tables of
// groups and clusters are read, and only by the constructor.
struct PagedBundle {
    ClusterTable table;
    std::shared_ptr<const PageSource> source;
};

// The memory that a pool may use for gaussians.
struct PoolMemory {
    size_t num_bytes;
    size_t row_bytes;               // per gaussian
    size_t cluster_bytes;           // per cluster, in addition to its gaussians
    size_t most_rows = UINT32_MAX;  // limit of the device's row indices

    size_t bytes_of(size_t num_rows, size_t num_clusters) const {
        return num_rows * row_bytes + num_clusters * cluster_bytes;
    }
};

// The division of the memory: the coarsest pages first, then slots of one size.
struct SlotPlan {
    size_t first_slot_row = 0, first_slot_cluster = 0;
    size_t num_slots = 0, slot_rows = 1, slot_clusters = 1;

    size_t num_rows() const { return first_slot_row + num_slots * slot_rows; }
    size_t num_clusters() const { return first_slot_cluster + num_slots * slot_clusters; }
    // Returns the number of cluster entries of a page of `num_clusters` clusters that
    // begins at entry `cluster`: all entries of its slot, or, for a coarsest page, one
    // per cluster.
    size_t num_clusters_at(size_t cluster, size_t num_clusters) const {
        return cluster < first_slot_cluster ? num_clusters : slot_clusters;
    }
    // [num_clusters() + 1] the first row of each cluster entry while all slots are
    // empty, ascending.
    std::vector<int64_t> empty_offsets() const;
};

// A page that becomes resident or is evicted.
struct PageChange {
    uint32_t bundle, page;
    int64_t row;                 // first row of the page; kAbsentPage: it is evicted
    size_t cluster;              // first cluster entry of the page
    const unsigned char* bytes;  // content of a page that becomes resident, else null
};

enum class PageState : uint8_t { absent, loading, loaded, resident, failed };

// A page that has been read and is not yet resident.
struct LoadedPage {
    uint32_t bundle, page;
    unsigned char* block;
    float priority = 0;  // priority in the last view that requested it
};

// The result of PagePolicy::bring() for loaded pages.
struct PagesComing {
    std::vector<PageChange> changes;      // to be applied in this order
    std::vector<unsigned char*> dropped;  // blocks of pages that are no longer wanted
    size_t bytes = 0;                     // size of the pages that become resident
    size_t num_left = 0;  // pages that wait only because of the bytes allowed per frame

    void clear();
};

// Any thread may call the const functions, except missing() and needed(). Only the
// deciding thread may call those two and all other functions.
class PagePolicy {
  public:
    // Throws std::invalid_argument if there is no room for the coarsest pages and one
    // more page of each bundle.
    PagePolicy(const std::vector<PagedBundle>& bundles, const PoolMemory& memory);

    size_t num_slots() const { return slots_.size(); }
    const SlotPlan& plan() const { return plan_; }
    // Returns the coarsest page of a bundle, without its bytes.
    PageChange root(size_t bundle) const;
    size_t num_pages() const { return slot_of_page_.size; }
    size_t most_page_bytes() const { return most_page_bytes_; }
    const PageSource& source(size_t bundle) const { return *bundles_[bundle].source; }
    // Returns the index of a page among the pages of all bundles.
    uint32_t id_of(size_t bundle, size_t page) const {
        return bundles_[bundle].first_page + static_cast<uint32_t>(page);
    }
    // Returns the index of the page above; negative if there is none.
    int32_t page_above(uint32_t id) const { return pages_[id].parent; }

    // Any thread may read the state of a page. Reading threads change it from absent to
    // loading, and from loading to loaded or failed.
    std::atomic<PageState>& state(size_t bundle, size_t page) const {
        return states_[id_of(bundle, page)];
    }
    void forget_failures();
    // Allocates memory for this many loaded pages, so that bring() never allocates.
    void reserve(size_t num_loaded) { left_.reserve(num_loaded); }

    // Notes the pages that the cut of a frame needs, absent or resident, in any order.
    // `num_left_out` is the number of further needs that the list had no room for.
    // `has_failures` says whether some pages cannot be read.
    void note(Span<const PageRequest> needs, size_t num_left_out, bool has_failures);
    // Sets `todo` to the pages to read next for the noted view. The most urgent stretch
    // comes last and each stretch is in descending order, because readers take pages
    // from the end, and pages above must come before those below. The list has at most
    // as many pages as there is room for besides the `under_way` pages that are loading
    // or loaded.
    void choose(size_t under_way, std::vector<PageRequest>& todo);
    // Return how many pages the noted view misses, and how many slots it would occupy.
    size_t missing() const { return missing_; }
    size_t needed() const { return missing_ + num_needed_; }

    // Assigns slots to loaded pages, the most urgent first, up to a total of about
    // `most_bytes`, but to at least one page. Pages that remain in `loaded` wait for a
    // later frame, or for a page above them that is still being read.
    void bring(std::vector<LoadedPage>& loaded, size_t most_bytes, PagesComing& out);

  private:
    struct Bundle {
        std::shared_ptr<const PageSource> source;
        uint32_t first_page = 0;
        size_t root_row = 0, root_cluster = 0;
        // Maxima over all pages except the coarsest.
        size_t most_rows = 1, most_clusters = 1, most_bytes = 1;
    };
    struct Page {
        int32_t parent = -1;   // index among the pages of all bundles; -1: a coarsest page
        uint32_t stamp = 0;    // the last view that requested the page
        float priority = 0;    // its priority in that view
        uint32_t stretch = 0;  // its stretch in that view, if the page is wanted
    };
    struct Slot {
        int32_t bundle = -1;
        uint32_t page = 0;
    };
    // When the page of a slot was last used.
    struct Use {
        uint32_t last_needed = 0;   // one more than the view that needed it last
        uint32_t last_used = 0;     // one more than the view that last needed it or nearly did
        int32_t above = 0;          // slot of the page above; negative: a coarsest page
        uint32_t num_children = 0;  // number of resident pages directly below
    };
    // The number of slots whose page this view needed or used, and of those whose page
    // only the view before did.
    struct Counts {
        size_t now = 0;
        size_t before = 0;
    };
    struct Wanted {
        uint32_t bundle;
        uint32_t page;
        uint32_t key;  // key of the urgency
    };
    // The part of `todo` for pages with one key: the number of free positions, and
    // their end.
    struct Places {
        uint32_t count = 0;
        uint32_t end = 0;
    };
    // A slot whose page may be evicted unless it was used again in the meantime.
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
    void touch(uint32_t& last, uint32_t value, Counts& counts);
    // Whether neither this view nor the one before needed or used the page.
    bool is_old(uint32_t last) const { return last < noted_; }
    size_t num_old(const Counts& counts) const {
        return slots_.size() - counts.now - counts.before;
    }
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

    // The slot of each page. A page without a slot is absent, being loaded, or the
    // coarsest of its bundle.
    Buffer<int32_t> slot_storage_;
    Buffer<Page> page_storage_;
    Span<int32_t> slot_of_page_;
    Span<Page> pages_;
    std::unique_ptr<std::atomic<PageState>[]> states_;

    std::vector<Slot> slots_;
    std::vector<Use> uses_;
    std::vector<uint32_t> free_slots_;

    uint32_t noted_ = 1;  // one more than the number of noted views
    Counts needed_, used_;
    size_t missing_ = 0, num_needed_ = 0;
    std::vector<Wanted> wanted_;
    std::vector<uint32_t> key_of_stretch_;
    std::vector<Places> places_of_key_;
    // A heap with the slot that was unused for longest in front. It persists from frame
    // to frame: slots that become old later were used later than those in the heap.
    std::vector<Leaving> leaving_;
    bool has_none_leaving_ = false;  // no slot can be evicted until the next view is noted
    std::vector<LoadedPage> left_;
};

}  // namespace v3dg

// Has libsumo process the links of a network in the order of their construction, and not of their addresses.
//
// SUMO collects pairs of conflicting links in MSLink::myRecheck, a std::set of pairs of pointers. At the end of each
// load, MSLink::recheckSetRequestInformation() walks it and appends to the conflicts of the links. What it appends
// depends on the order, so the same network behaves differently where the allocator returns other addresses.
//
// - libsumo calls its own functions through a table of addresses. This library finds the entries of two functions there
//   and replaces them. That works however and whenever libsumo was loaded, with all versions that export the functions.
// - Instead of the constructor of MSLink, `construct` runs: it notes the order of construction and calls the
// constructor.
// - Instead of the recheck, `recheck` runs: it calls the recheck once per pair, with the set holding that pair alone.
// - Where an assumption fails, libsumo's own recheck runs once on the whole set, as without this library, and the load
//   counts as unordered.
//
// crashhunt/native/_link_order.py loads and binds it, and lists the versions of libsumo that it was checked with.

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <dlfcn.h>
#include <link.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <set>
#include <unordered_map>
#include <utility>
#include <vector>

#ifndef CRASHHUNT_INTERFACE
#error "scripts/build_core.py defines CRASHHUNT_INTERFACE"
#endif

#if defined(__x86_64__)
#define IS_ENTRY(type) ((type) == R_X86_64_JUMP_SLOT || (type) == R_X86_64_GLOB_DAT)
#elif defined(__aarch64__)
#define IS_ENTRY(type) ((type) == R_AARCH64_JUMP_SLOT || (type) == R_AARCH64_GLOB_DAT)
#else
#error "it is for x86-64 and AArch64"
#endif

#define EXPORTED __attribute__((visibility("default")))
#define CONSTRUCT "_ZN6MSLinkC1EP6MSLaneS1_S1_13LinkDirection9LinkStateddbP19MSTrafficLightLogicib"
#define RECHECK "_ZN6MSLink28recheckSetRequestInformationEv"
#define PAIRS "_ZN6MSLink9myRecheckE"

namespace {

typedef std::pair<void *, void *> Pair;
typedef std::set<Pair> Pairs;
typedef void (*Recheck)();
typedef void (*Construct)(void *, void *, void *, void *, int, int, double, double, bool, void *, int, bool);

struct Libsumo {
    Recheck recheck;
    Construct construct;
    Pairs *pairs;
};
Libsumo libsumo = {};
bool in_use = true;
long long ordered_loads = 0, unordered_loads = 0;

// In the order of construction; links of an abandoned load may be among them. The memory is reserved at once, which the
// allocator maps by itself, so that the addresses of libsumo's objects stay as they are without this library.
std::vector<void *> &constructed() {
    static std::vector<void *> links;
    if (!links.capacity()) {
        links.reserve(1 << 17);
    }
    return links;
}

// The mangled name of a variable does not contain its type, so compare its size and the state of an empty set.
bool is_empty_set(void *variable) {
    Dl_info found;
    ElfW(Sym) *symbol = nullptr;
    if (!dladdr1(variable, &found, reinterpret_cast<void **>(&symbol), RTLD_DL_SYMENT) || !symbol) {
        return false;
    }
    if (found.dli_saddr != variable || symbol->st_size != sizeof(Pairs)) {
        return false;
    }
    // libstdc++: comparator, color, root, leftmost, rightmost, count. Without elements, both ends are the header.
    const char *header = static_cast<const char *>(variable) + 8;
    const char *const *words = static_cast<const char *const *>(variable);
    return !words[2] && words[3] == header && words[4] == header && static_cast<const Pairs *>(variable)->empty();
}

// The entries of a function in the table of addresses of a library.
std::vector<void **> entries_of(const link_map *library, const char *function) {
    const ElfW(Sym) *symbols = nullptr;
    const char *names = nullptr;
    uintptr_t tables[2] = {};
    size_t bytes[2] = {};
    for (const ElfW(Dyn) *at = library->l_ld; at->d_tag != DT_NULL; at++) {
        const uintptr_t address = at->d_un.d_ptr; // the dynamic linker has made it absolute
        switch (at->d_tag) {
        case DT_SYMTAB: symbols = reinterpret_cast<const ElfW(Sym) *>(address); break;
        case DT_STRTAB: names = reinterpret_cast<const char *>(address); break;
        case DT_JMPREL: tables[0] = address; break;
        case DT_PLTRELSZ: bytes[0] = at->d_un.d_val; break;
        case DT_RELA: tables[1] = address; break;
        case DT_RELASZ: bytes[1] = at->d_un.d_val; break;
        default: break;
        }
    }
    std::vector<void **> found;
    for (int table = 0; symbols && names && table < 2; table++) {
        const ElfW(Rela) *entry = reinterpret_cast<const ElfW(Rela) *>(tables[table]);
        for (size_t left = entry ? bytes[table] / sizeof *entry : 0; left > 0; left--, entry++) {
            if (IS_ENTRY(ELF64_R_TYPE(entry->r_info)) &&
                !strcmp(names + symbols[ELF64_R_SYM(entry->r_info)].st_name, function)) {
                found.push_back(reinterpret_cast<void **>(library->l_addr + entry->r_offset));
            }
        }
    }
    return found;
}

// Whether libsumo calls its own function there, or will when it has looked the function up.
bool all_lead_into_library_of(void *function, const std::vector<void **> &entries) {
    Dl_info library, found;
    if (!dladdr(function, &library)) {
        return false;
    }
    for (void **entry : entries) {
        if (!dladdr(*entry, &found) || found.dli_fbase != library.dli_fbase) {
            return false;
        }
    }
    return !entries.empty();
}

bool make_writable(const std::vector<void **> &entries) {
    const uintptr_t page = static_cast<uintptr_t>(sysconf(_SC_PAGESIZE));
    for (void **entry : entries) {
        void *start = reinterpret_cast<void *>(reinterpret_cast<uintptr_t>(entry) & ~(page - 1));
        if (mprotect(start, page, PROT_READ | PROT_WRITE)) {
            return false;
        }
    }
    return true;
}

bool in_order_of_construction(std::vector<Pair> &pairs) {
    std::unordered_map<void *, size_t> rank;
    const std::vector<void *> &links = constructed();
    for (size_t at = 0; at < links.size(); at++) {
        rank[links[at]] = at; // an address is used again after an abandoned load, so that the latest counts
    }
    std::vector<std::pair<std::pair<size_t, size_t>, Pair>> ranked;
    for (const Pair &pair : pairs) {
        const auto first = rank.find(pair.first), second = rank.find(pair.second);
        if (first == rank.end() || second == rank.end()) {
            return false;
        }
        ranked.push_back({{first->second, second->second}, pair});
    }
    std::sort(ranked.begin(), ranked.end());
    for (size_t at = 0; at < pairs.size(); at++) {
        pairs[at] = ranked[at].second;
    }
    return true;
}

void construct(void *self, void *from, void *to, void *via, int direction, int state, double length, double visibility,
               bool keep_clear, void *logic, int index, bool indirect) {
    if (in_use) {
        constructed().push_back(self);
    }
    libsumo.construct(self, from, to, via, direction, state, length, visibility, keep_clear, logic, index, indirect);
}

void recheck() {
    std::vector<Pair> pairs;
    bool ordered = in_use;
    if (ordered) {
        pairs.assign(libsumo.pairs->begin(), libsumo.pairs->end());
        ordered = in_order_of_construction(pairs);
    }
    constructed().clear();
    if (!ordered) {
        unordered_loads++;
        libsumo.recheck();
        return;
    }
    ordered_loads++;
    libsumo.pairs->clear();
    for (const Pair &pair : pairs) {
        libsumo.pairs->insert(pair);
        libsumo.recheck(); // which empties the set
    }
}

} // namespace

extern "C" {

EXPORTED int crashhunt_link_order_interface() { return CRASHHUNT_INTERFACE; }

// Replaces libsumo's functions in its library, which is loaded. Returns why that is impossible, or null.
EXPORTED const char *crashhunt_link_order_bind(const char *path) {
    if (libsumo.pairs) {
        return nullptr;
    }
    void *library = dlopen(path, RTLD_LAZY | RTLD_NOLOAD);
    link_map *map = nullptr;
    if (!library || dlinfo(library, RTLD_DI_LINKMAP, &map)) {
        return "libsumo is not loaded";
    }
    Libsumo found;
    found.recheck = reinterpret_cast<Recheck>(dlsym(library, RECHECK));
    found.construct = reinterpret_cast<Construct>(dlsym(library, CONSTRUCT));
    found.pairs = static_cast<Pairs *>(dlsym(library, PAIRS));
    if (!found.recheck || !found.construct || !found.pairs) {
        return "libsumo lacks a function or variable of its class MSLink";
    }
    if (!is_empty_set(found.pairs)) {
        return "MSLink::myRecheck of libsumo is not an empty std::set";
    }
    const std::vector<void **> rechecks = entries_of(map, RECHECK), constructs = entries_of(map, CONSTRUCT);
    if (!all_lead_into_library_of(found.pairs, rechecks) || !all_lead_into_library_of(found.pairs, constructs)) {
        return "libsumo calls functions of its class MSLink in another way";
    }
    if (!make_writable(rechecks) || !make_writable(constructs)) {
        return "the system protects libsumo's table of addresses";
    }
    libsumo = found;
    for (void **entry : rechecks) {
        *entry = reinterpret_cast<void *>(&recheck);
    }
    for (void **entry : constructs) {
        *entry = reinterpret_cast<void *>(&construct);
    }
    return nullptr;
}

// Whether the next loads are ordered; otherwise libsumo's own order is kept.
EXPORTED void crashhunt_link_order_use(int use) { in_use = use; }

EXPORTED long long crashhunt_link_order_ordered_loads() { return ordered_loads; }

EXPORTED long long crashhunt_link_order_unordered_loads() { return unordered_loads; }
}

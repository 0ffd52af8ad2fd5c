/* Permutes the addresses that malloc returns, to show what depends on them: LD_PRELOAD it, and set HEAP_ORDER=SEED.
 *
 * Each block of up to LARGEST bytes is drawn from POOL blocks of its size that the C library has returned already.
 * So every block is the C library's own, and free, realloc and others need no replacement. Without HEAP_ORDER, or
 * with 0, malloc is the C library's.
 */

#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define LARGEST 2048
#define POOL 256

extern void *__libc_malloc(size_t);

static void *pools[LARGEST / 16 + 1][POOL];
static unsigned long long state; /* 0: malloc is the C library's; so it is before the environment can be read */
static int lock;

__attribute__((constructor)) static void read_seed(void) {
    const char *seed = getenv("HEAP_ORDER");
    state = seed ? strtoull(seed, NULL, 10) * 0x9E3779B97F4A7C15ull : 0;
}

static unsigned long long next_number(void) { /* xorshift64 */
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

void *malloc(size_t size) {
    const size_t of_size = (size + 15) / 16;
    if (!state || of_size * 16 > LARGEST) {
        return __libc_malloc(size);
    }
    while (__sync_lock_test_and_set(&lock, 1)) {
    }
    void **pool = pools[of_size];
    if (!pool[0]) {
        for (int at = 0; at < POOL; at++) {
            pool[at] = __libc_malloc(of_size * 16);
        }
    }
    const unsigned at = (unsigned)(next_number() % POOL);
    void *block = pool[at], *fresh = __libc_malloc(of_size * 16);
    if (fresh) { /* otherwise memory is full, and this block stays in the pool */
        pool[at] = fresh;
    } else {
        block = NULL;
    }
    __sync_lock_release(&lock);
    return block;
}

void *calloc(size_t count, size_t size) {
    size_t bytes;
    if (__builtin_mul_overflow(count, size, &bytes)) {
        return NULL;
    }
    void *block = malloc(bytes);
    return block ? memset(block, 0, bytes) : NULL;
}

/* What a Cortex-M4 does first: vectors, the FPU, data and zeros of RAM; then main, whose words leave by semihosting. */
extern unsigned int _data_from, _data, _data_end, _bss, _bss_end, _stack;
void initialise_monitor_handles(void);
int main(void);
void exit(int status);
void start(void);

void start(void)
{
    *(volatile unsigned int *)0xE000ED88u |= 0xFu << 20; /* CPACR: full access to the FPU, which is off at reset */
    for (unsigned int *from = &_data_from, *to = &_data; to < &_data_end;) *to++ = *from++;
    for (unsigned int *to = &_bss; to < &_bss_end;) *to++ = 0;
    initialise_monitor_handles();
    exit(main());
}

static void halt(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    &_stack, (void *)start, (void *)halt, (void *)halt, (void *)halt, (void *)halt, (void *)halt,
};
